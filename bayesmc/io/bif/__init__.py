"""The Bayesian Interchange Format (BIF) as plain records: text becomes `TableNode` and back.

This room knows the file format only; `bayesmc.io` turns the records into nets.
"""

from bayesmc.io.bif.reader import parse_bif
from bayesmc.io.bif.writer import format_bif
from bayesmc.io.content import read_text
from bayesmc.io.record import TableNode

__all__ = ["TableNode", "format_bif", "parse_bif", "read_text"]
