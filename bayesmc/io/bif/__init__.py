"""The Bayesian Interchange Format (BIF) as plain records: text becomes `BifNode` and back.

This room knows the file format only; `bayesmc.io` turns the records into nets.
"""

from bayesmc.io.bif.reader import ROW_TOLERANCE, parse_bif, read_text
from bayesmc.io.bif.record import BifNode
from bayesmc.io.bif.writer import format_bif

__all__ = ["ROW_TOLERANCE", "BifNode", "format_bif", "parse_bif", "read_text"]
