"""XMLBIF 0.3, the interchange format in XML, as plain records: text becomes `TableNode` and back.

This room knows the file format only; `bayesmc.io` turns the records into nets.
"""

from bayesmc.io.xmlbif.reader import parse_xmlbif
from bayesmc.io.xmlbif.writer import format_xmlbif

__all__ = ["format_xmlbif", "parse_xmlbif"]
