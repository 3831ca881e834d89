"""Speed measurements: bayesmc beside hand-written floors and beside peer libraries.

Importing it before NumPy keeps this process's linear algebra to one thread: the baselines are for
one thread, and a second core that comes and goes would spoil every ratio. Peers run in processes of
their own and keep their own defaults.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
THREADS = {name: "1" for name in _VARIABLES if name not in os.environ}
os.environ.update(THREADS)
