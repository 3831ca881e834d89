"""A peer that waits: prepared once, then one line in, one line out, so that runs interleave.

``python server.py JOB NETWORK [DRAWS]`` prints ``{"ready": JOB}``. Each line on stdin is an object
``{"evidence": {node: state}, "answer": bool}`` and is answered by ``{"seconds": s, "cpu_seconds": c}``,
with ``"marginals": {node: {state: p}}`` where the answer is asked for, or by ``{"error": text}``. The
clocks run here, around the peer's own work: no pipe is timed. The end of stdin ends the server.
"""

from __future__ import annotations

import json
import os
import sys
import time

import exact
import lw

JOBS = {"lw-pgmpy": lw.pgmpy, "lw-pyagrum": lw.pyagrum, "exact-pyagrum": exact.pyagrum}


def main(job: str, network: str, draws: str = "100000") -> None:
    """Serve one job until stdin ends."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a peer prints must not pass for a reply
    run = JOBS[job](network, int(draws))
    print(json.dumps({"ready": job}), file=replies)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            start, busy = time.perf_counter(), time.process_time()
            marginals = run(request["evidence"])
            busy = time.process_time() - busy
            reply: dict = {"seconds": time.perf_counter() - start, "cpu_seconds": busy}
        except Exception as error:  # the benchmark goes on without this peer
            reply = {"error": f"{type(error).__name__}: {error}"}
        else:
            if request.get("answer"):
                reply["marginals"] = marginals
        print(json.dumps(reply), file=replies)


if __name__ == "__main__":
    main(*sys.argv[1:])
