"""Reference models run by PyMC in the peers' environment: those that NUTS suits, and a start does not decide.

The others have discrete unknowns or so few numbers that JAGS is done before PyMC has compiled.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks import THREADS
from benchmarks.harness import peer_python
from references.case import Case, split
from references.peers import jags
from references.peers.figures import Peer

_SCRIPT = Path(__file__).with_name("pymc_models.py")

#: case -> the model's name there; data and other names are those of JAGS's text
MODELS = {
    "arK": "regression",
    "earn_height": "regression, flat and wide",
    **dict.fromkeys(
        (
            "log10earn_height",
            "logearn_height",
            "logearn_height_male",
            "logearn_interaction",
            "logearn_interaction_z",
            "logearn_logheight_male",
            "kilpisjarvi",
        ),
        "regression, flat",
    ),
    **{f"kidscore_{name}": "regression" for name in ("momhs", "momiq", "momhsiq", "interaction")},
    "eight_schools_noncentered": "schools",
    "low_dim_gauss_mix": "mixture",
    "seeds test1": "seeds",
    "seeds test2": "seeds, to zero",
    "seeds test3": "seeds, exponential",
    "seeds test4": "seeds, uniform",
    "seeds test5": "seeds, uniform",
    "salm test1": "salm",
    "salm test2": "salm, uniform",
    "epil test1": "epil",
    "epil test2": "epil, visits",
}


def run(case: Case, root: Path) -> Peer:
    """Four chains of 1,000 draws, as PyMC does by default, on one core."""
    values, seconds = draws(case, root)
    chains, count = next(iter(values.values())).shape
    return Peer(round(jags.smallest(values), 1), round(seconds, 3), f"{chains} x {count}")


def draws(case: Case, root: Path) -> tuple[dict[str, np.ndarray], float]:
    """What is published, (chain, draw) each, and processor seconds."""
    text = jags.TEXTS[case.name]
    content = {name: np.asarray(v).tolist() for name, v in text.data(case, root).items()}
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    environment["OMP_NUM_THREADS"] = environment["OPENBLAS_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as folder:
        data, target = Path(folder) / "data.json", Path(folder) / "draws.npz"
        data.write_text(json.dumps(content))
        command = [str(peer_python()), str(_SCRIPT), MODELS[case.name], str(data), str(target)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"PyMC failed on {case.name}:\n{done.stderr[-2000:]}")
        found = dict(np.load(target))
    seconds = float(found.pop("seconds"))
    values = {}
    for name in case.published(root):
        base, index = split(text.names.get(name, name))
        values[name] = found[base][(slice(None), slice(None), *index)]
    return values, seconds


def version() -> str:
    """PyMC's."""
    command = [str(peer_python()), "-c", "import pymc; print(pymc.__version__)"]
    return "PyMC " + subprocess.run(command, capture_output=True, text=True).stdout.strip()
