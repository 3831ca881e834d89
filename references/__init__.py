"""Published posteriors that bayesmc is held against: the models, the figures, the verdicts.

``bugs`` states the classic BUGS examples, ``posteriordb`` the models with reference draws; ``case``
says what a case is, ``quadrature`` works out what heavy tails hide from moments, ``verdict`` compares
and ``run`` makes the table. Nothing here is part of the library, and no data is kept here: it is read
from the folder that ``BAYESMC_DATA`` names, else from ``../shared/data``.
"""

from references.bugs import BUGS
from references.case import Case, Figures, Question, data_folder
from references.posteriordb import POSTERIORDB

CASES: tuple[Case, ...] = (*BUGS, *POSTERIORDB)

__all__ = ["BUGS", "CASES", "POSTERIORDB", "Case", "Figures", "Question", "data_folder"]
