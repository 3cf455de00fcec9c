# Everything a fresh machine needs is Python 3.11 or newer, make and git.
#
#   make run [ARGS="model=w99 policy=lstm"]   set up .venv, then run one job
#   make test                                 set up .venv, then ruff, mypy and the fast tests: what CI runs
#   make test-slow | make bench               the tests that take minutes | the benchmarks
#   make golden | make golden-write           compare the results of small jobs, bit for bit, with recorded ones | record them anew
#   make settings [EVERY=20]                  each setting of each option changes what a job writes, or is refused (every 20th alone)
#   make fuzz [EXAMPLES=5000]                 bad configurations, recordings, policies and caches; each file of a job fails once
#   make hostile [FILES=1000]                 hostile but plausible recordings: read as they are meant, or refused with the reason
#   make mutants [MUTANTS=300 SEED=0 ROOMS="calibration simulation" SECONDS=60]   change the code at random; what no test of its room notices
#   make kills [KILLS=100]                    kill a sweep at random moments, with each launcher
#   make policies                             train the ready-made policies anew from ../shared/data (two hours)
#   make dist                                 build cfx and the plugins into dist/, install cfx alone into a clean environment, then all, try both
#   make beside [NAMES=cfx-sumo]              run each distribution's tests where of cfx only the core and what it needs are installed
#   make results [KEYS="unseen-idm"]          measure what documents state: what docs/results.json lacks, or these jobs anew; then make tables
#   make tables                               write the numbers of docs/results.json and of policies' cards into the documents
#   make docs                                 build the site from docs/ and the docstrings into site/; warnings are errors
#   make tutorials                            run the tutorials and write their pages anew (a quarter of an hour)
#   make conf                                 write anew what follows from the code: conf/<group>/<name>.yaml, which plugin brings what, the door's page, templates
#   make lock                                 write constraints.txt anew from what resolves today
#   make clean                                remove .venv and every cache; outputs/ stays

PYTHON ?= python3
VENV ?= .venv
ARGS ?=
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# PyTorch for Linux comes from PyPI with CUDA, several GB; a CPU build says so in its version (2.13.0+cpu) and satisfies the same
# pin. So the first step looks for a CPU build: in the sources that pip is set up with, then on PyTorch's own index, which has a few
# seconds to answer. Without either, pip takes what PyPI has. For a GPU: make run TORCH_INDEX= (empty: the step is left out).
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH = $(shell sed -n 's/^torch==//p' constraints.txt)

.PHONY: run test test-slow golden golden-write settings fuzz hostile mutants kills bench policies results tables docs tutorials dist beside conf lock clean

run: $(VENV)/.ready
	$(BIN)/python -m cfx $(ARGS)

test: $(VENV)/.ready-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

test-slow: $(VENV)/.ready-test
	$(BIN)/python -m pytest -m slow

golden golden-write: $(VENV)/.ready-test
	OMP_NUM_THREADS=1 CFX_GOLDEN=$(if $(filter golden-write,$@),write) $(BIN)/python -m pytest -m slow tests/golden

settings: $(VENV)/.ready-test
	OMP_NUM_THREADS=1 CFX_SETTINGS_EVERY=$(or $(EVERY),1) $(BIN)/python -m pytest -m slow tests/settings -s

fuzz: $(VENV)/.ready-test
	CFX_FUZZ_EXAMPLES=$(or $(EXAMPLES),5000) CFX_FAULTS_STRIDE=1 $(BIN)/python -m pytest tests/fuzz --timeout 0 -n auto

hostile: $(VENV)/.ready-test
	$(BIN)/python -m tests.benchmarks.hostile_files --files $(or $(FILES),1000) --data $(DATA)

# Goes on where it was interrupted; a mutant meets tests of SECONDS at most, and takes three times as long where it hangs.
mutants: $(VENV)/.ready-test
	$(PIP) install --quiet --constraint constraints.txt --editable '.[mutants]'
	$(BIN)/python -m tests.mutants --count $(or $(MUTANTS),300) --seed $(or $(SEED),0) --seconds $(or $(SECONDS),60) $(if $(ROOMS),--rooms $(ROOMS))

kills: $(VENV)/.ready-test
	CFX_KILLS=$(or $(KILLS),100) $(BIN)/python -m pytest -m slow tests/fuzz/test_kills.py -s

bench: $(VENV)/.ready-test
	$(BIN)/python -m pytest tests/benchmarks plugins/*/tests/benchmarks -m "" --override-ini addopts="--import-mode=importlib" --benchmark-only

DATA ?= ../shared/data

policies: $(VENV)/.ready-test
	$(BIN)/python -m cfx policies make --data $(DATA)
	$(BIN)/python docs/tables.py

results: $(VENV)/.ready-test
	OMP_NUM_THREADS=1 $(BIN)/python docs/measure.py --data $(DATA) $(KEYS)
	$(BIN)/python docs/tables.py

tables: $(VENV)/.ready
	$(BIN)/python docs/tables.py

# Pages lie beside the site's as Markdown too: llms.txt names them.
# Zensical's --strict stops on links without a target; docstrings that do not fit their signatures are only printed, so they are looked for.
docs: $(VENV)/.ready-docs
	$(BIN)/zensical build --clean --strict >site.log 2>&1 || { cat site.log; exit 1; }
	cd docs && find . -name "*.md" | tar cf - -T - | tar xf - -C ../site
	@cat site.log; ! grep -qE "^(griffe|mkdocstrings):" site.log && rm site.log

tutorials: $(VENV)/.ready-test
	$(BIN)/python docs/tutorials/run.py

# Wheels are built from the sdists. The clean environment has what a user's pip would install, at the pinned versions.
dist: $(VENV)/.ready-test
	rm -rf dist .venv-dist
	$(PIP) install --quiet --constraint constraints.txt --editable '.[dist]'
	for folder in . plugins/*/; do $(BIN)/python -m build --quiet --outdir dist $$folder || exit 1; done
	$(BIN)/python -m twine check --strict dist/*
	$(MAKE) VENV=.venv-dist .venv-dist/.torch
	.venv-dist/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt dist/cfx_driving-*.whl
	.ci/alone .venv-dist/bin
	.venv-dist/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt \
	  dist/cfx_*.whl "cfx-driving[joblib] @ file://$$(echo $(CURDIR)/dist/cfx_driving-*.whl)"
	.ci/smoke .venv-dist/bin
	rm -rf .venv-dist

beside:
	rm -rf .venv-beside
	$(MAKE) VENV=.venv-beside .venv-beside/.torch
	.venv-beside/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt --editable '.[test]'
	.ci/beside .venv-beside/bin $(NAMES)
	rm -rf .venv-beside

conf: $(VENV)/.ready
	$(BIN)/python -m cfx.app.nodes
	$(BIN)/python docs/door.py
	$(BIN)/python plugins/cfx-contracts/templates.py

# The stamps are made again when what they were made from changes, so a second `make run` installs nothing.
# What README's commands need comes from plugins/ too: the readers of published recordings, the benchmark, SUMO, traffic.
EVERYBODYS = plugins/cfx-community plugins/cfx-contracts plugins/cfx-forecasts plugins/cfx-posteriors plugins/cfx-recordings plugins/cfx-report plugins/cfx-sumo
$(VENV)/.ready: pyproject.toml $(EVERYBODYS:%=%/pyproject.toml) constraints.txt $(VENV)/.torch
	$(PIP) install --quiet --constraint constraints.txt $(addprefix --editable ,. $(EVERYBODYS))
	touch $@

# The plugins in this repository are distributions of their own; what they need is in the test extra.
$(VENV)/.ready-test: pyproject.toml constraints.txt $(wildcard plugins/*/pyproject.toml) $(VENV)/.torch
	$(PIP) install --quiet --constraint constraints.txt --editable '.[test]'
	$(PIP) install --quiet --no-deps $(addprefix --editable ,$(wildcard plugins/*/))
	touch $(VENV)/.ready $@

$(VENV)/.ready-docs: pyproject.toml constraints.txt $(VENV)/.ready
	$(PIP) install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@

$(VENV)/.torch: constraints.txt | $(BIN)/python
ifneq ($(TORCH_INDEX),)
	@if [ "$$(uname -s)" = Linux ] && ! $(BIN)/python -c "import torch" 2>/dev/null; then \
	  echo "installing torch $(TORCH), CPU build"; \
	  $(PIP) install --quiet --no-deps "torch==$(TORCH)+cpu" 2>/dev/null \
	  || $(PIP) install --quiet --no-deps --isolated --retries 0 --timeout 5 --index-url "$(TORCH_INDEX)" "torch==$(TORCH)+cpu" 2>/dev/null \
	  || echo "no CPU build within reach; the next step takes the one that PyPI has"; \
	fi
endif
	touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "cfx needs Python 3.11 or newer; name one with make PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# Local versions (+cpu) and cfx itself stay out, so that the pins hold for every build and every checkout. torch keeps its pin: raise it
# by hand first.
lock:
	rm -rf .venv-lock
	$(PYTHON) -m venv .venv-lock
	$(MAKE) VENV=.venv-lock .venv-lock/.torch
	.venv-lock/bin/python -m pip install --quiet --upgrade --editable '.[test,docs,dist,mutants]'
	{ echo "# Versions that were tested together; make lock writes this file. pip install --constraint constraints.txt ..."; \
	  .venv-lock/bin/python -m pip freeze --exclude-editable | sed 's/+cpu$$//'; } > constraints.new
	mv constraints.new constraints.txt
	rm -rf .venv-lock

clean:
	rm -rf $(VENV) .venv-lock .venv-dist .venv-beside .mutants .mypy_cache .ruff_cache .pytest_cache .hypothesis .benchmarks dist site site.log
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
