"""Units of work on other threads, processes or machines: any ``concurrent.futures`` executor.

A unit is a function of something that all units share (a posed problem) and something of its own (which
chains, which series), with a random stream of its own. So what comes out does not depend on who works it out,
or when. This room knows how units travel, what is done where a worker is lost, and in which order results are
handed on; what a unit is, engines know.
"""

from bayesmc.workers.units import check_executor, completed, in_order

__all__ = ["check_executor", "completed", "in_order"]
