"""Nets of other libraries become nets, and nets become graphs of networkx.

The adapters read the objects they are given by their attributes and import no library to do so.
"""

from bayesmc.io.adapters.networkx import to_networkx
from bayesmc.io.adapters.pgmpy import from_pgmpy
from bayesmc.io.adapters.pyagrum import from_pyagrum

__all__ = ["from_pgmpy", "from_pyagrum", "to_networkx"]
