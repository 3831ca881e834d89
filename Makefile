# Every target sets up what it needs; the second time that costs nothing. Paths stay relative and
# tools run as `python -m`, so a checkout whose path holds spaces works.

# The first Python that is new enough; `make PYTHON=/path/to/python3.12 test` overrides.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo $$p && break; done)
PY = .venv/bin/python
PIP_FLAGS = --disable-pip-version-check -q

.PHONY: help demo test test-thorough mutants alarms lint format counts docs site dist bench speed peers references clean
.NOTPARALLEL:

help:
	@echo "make demo    run the demonstration; pictures go to out/"
	@echo "make test    run the tests, doctests and examples included"
	@echo "make test-thorough  the same with fresh seeds and more draws; BAYESMC_SEED=N repeats a run (long)"
	@echo "make mutants  show that each of a list of planted faults is caught"
	@echo "make alarms  count the false alarms of the statistical tests (long)"
	@echo "make lint    ruff, formatting, mypy"
	@echo "make format  let ruff mend formatting and import order"
	@echo "make counts  count lines, the modules that a call runs in, and the functions that are followed"
	@echo "make docs    run every snippet of README, docs and docstrings, and build the site: out/site"
	@echo "make site    build the site alone"
	@echo "make dist    build wheel and sdist, check them, and ask the wheel a question in an empty environment"
	@echo "make bench   time bayesmc beside hand-written code (and peers, after 'make peers')"
	@echo "make speed   write docs/speed.md from what some of the benchmarks measure"
	@echo "make peers   install the packages that the benchmarks compare with, in .venv-peers"
	@echo "make references  hold bayesmc against BUGS and posteriordb, beside JAGS and PyMC: docs/accuracy.md (long)"
	@echo "make clean   remove what the other targets made"

demo: .venv/.extras-plot,robotics,vision
	$(PY) -m examples.demo

# Bytecode is kept, in .venv, also where the environment says not to: many tests start a Python of their own.
TEST = PYTHONDONTWRITEBYTECODE= PYTHONPYCACHEPREFIX="$(CURDIR)/.venv/bytecode" OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -q \
	-n auto --dist worksteal

test: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	$(TEST)

# the last lines say the seed; `make test-thorough BAYESMC_SEED=N` takes it again
test-thorough: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	$(TEST) --bayesmc-thorough

mutants: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	OPENBLAS_NUM_THREADS=1 $(PY) -m tests.mutants

alarms: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	OPENBLAS_NUM_THREADS=1 $(PY) -m tests.alarms

lint: .venv/.extras-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

format: .venv/.extras-dev
	$(PY) -m ruff check --fix-only -q .
	$(PY) -m ruff format .

counts: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	OPENBLAS_NUM_THREADS=1 $(PY) -m tests.counts

# Warnings are errors, and so are links that lead nowhere. Without a network the links into other projects' pages are left out.
SITE = OPENBLAS_NUM_THREADS=1 $(PY) -m sphinx -q -W --keep-going -b html docs out/site && \
	$(PY) docs/links.py out/site && echo "the site is in out/site/index.html"

docs: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,docs
	$(PY) -m pytest -q tests/test_readme.py tests/test_docs.py tests/test_doctests.py
	$(SITE)

site: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,docs
	$(SITE)

# What is released: both archives are built and checked, and the wheel is asked a question where nothing else is.
dist: .venv/.extras-dev
	rm -rf dist build/release
	$(PY) -m build -q
	$(PY) -m twine check --strict dist/*
	$(PY) -m venv build/release
	build/release/bin/python -m pip install $(PIP_FLAGS) dist/*.whl
	cd build/release && bin/python -W error -c 'import bayesmc as bmc; net = bmc.BayesNet(); \
		net.add("k", bmc.Bernoulli(0.25)); net.add("x", lambda k: bmc.Normal(2.0 * k, 1.0)); \
		found = bmc.infer(net, {"x": 1.0}).mean("k"); assert abs(found - 0.25) < 1e-12, found; \
		print("bayesmc", bmc.__version__, "answers from its wheel")'
	@ls -l dist

bench: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	$(PY) -m benchmarks

speed: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	$(PY) -m benchmarks.page

peers: .venv-peers/.installed

# BAYESMC_DATA says where the published posteriors are
references: .venv/.extras-plot,arviz,netcdf,robotics,vision,fast,test
	$(PY) -m references

clean:
	rm -rf .venv .venv-peers out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

# One stamp per set of extras, so that `make demo` waits for no test tools.
.venv/.extras-%: pyproject.toml .venv/.created
	@echo "installing bayesmc[$*] into .venv ..."
	@$(PY) -m pip install $(PIP_FLAGS) -e ".[$*]"
	@touch "$@"

.venv/.created:
	@test -n "$(PYTHON)" || { \
		echo "bayesmc needs Python >= 3.11 and none was found; install one, or name it: make PYTHON=/path/to/python3.12 ..." >&2; \
		exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
		"bayesmc needs Python >= 3.11, but $(PYTHON) is " + sys.version.split()[0])'
	@"$(PYTHON)" -m venv --clear .venv || { \
		echo "could not make .venv; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@touch "$@"

PEERS = benchmarks/peers/requirements
.venv-peers/.installed: $(PEERS).txt $(PEERS)-alone.txt .venv/.created
	$(PY) -m venv --clear .venv-peers
	.venv-peers/bin/python -m pip install $(PIP_FLAGS) -r $(PEERS).txt
	.venv-peers/bin/python -m pip install $(PIP_FLAGS) --no-deps -r $(PEERS)-alone.txt
	@touch "$@"
