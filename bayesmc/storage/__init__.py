"""Files that last: values packed as data, blocks that are appended, images that ArviZ opens.

Knows arrays and bytes, no nets and no engines. A file is a NetCDF image with blocks of a run behind it, which
readers of NetCDF do not see; when the run has ended, all is in the image.
"""

from bayesmc.storage.blocks import Blocks
from bayesmc.storage.image import Group, Lazy, Variable, is_ours, open_image, write_image
from bayesmc.storage.packing import packed, unpacked
from bayesmc.storage.saver import CheckpointFile, PartFile, Saver

__all__ = [
    "Blocks",
    "CheckpointFile",
    "Group",
    "Lazy",
    "PartFile",
    "Saver",
    "Variable",
    "is_ours",
    "open_image",
    "packed",
    "unpacked",
    "write_image",
]
