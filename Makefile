# sdfhub: `make demo` and `make test` are all the set-up there is.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev

.DEFAULT_GOAL := help
.PHONY: help install demo test lint data bench clean

help: ## list these targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 20

install: $(STAMP) ## install sdfhub into .venv with the versions of constraints.txt, without extras

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sdfhub needs Python 3.11 or newer; say which: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

$(DEV_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: install ## train SIREN + Fourier + normals on 300 procedural chairs, judge 8 of them and 8 unseen ones (minutes)
	$(BIN)/python train.py experiment=fft_siren scale=demo

test: $(DEV_STAMP) ## run the tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

lint: $(DEV_STAMP) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

data: install ## fetch and unpack the real meshes of data=open into data/open (no root needed)
	$(BIN)/python -m sdfhub.data.fetch

BENCHMARKS := training growth procedural preparation large_mesh meshing evaluation fitting accuracy

bench: install ## time all of it on this machine (a good half hour on two cores, 9 GB of disk meanwhile)
	for name in $(BENCHMARKS); do printf "\n%s.py\n" $$name; $(BIN)/python benchmarks/$$name.py || exit 1; done

clean: ## remove the environment; prepared data and runs stay
	rm -rf $(VENV)
