# Every target does its own set-up (.ci/setup). Two commands matter: make report [SESSION=path] and make test.
SESSION ?=
PYTHON ?= python3
RUN := .venv/bin/python
# one thread a process: two notebooks run side by side, and sums come out the same on every machine
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help setup report test notebooks lab clean

help:
	@echo "make report [SESSION=path]   execute the notebooks on a session, write reports/<session>/"
	@echo "make test                    lint and run all tests, the notebooks included"
	@echo "make notebooks [SESSION=..]  execute the notebooks and store them"
	@echo "make lab [SESSION=path]      open JupyterLab"
	@echo "make clean                   remove the environment, reports and caches"

setup:
	@PYTHON="$(PYTHON)" .ci/setup

report: setup
	@$(RUN) -m lrfcal_lib.report $(if $(SESSION),"$(SESSION)")

test: setup
	$(RUN) -m ruff check .
	$(RUN) -m pytest

notebooks: setup
	@$(RUN) -m lrfcal_lib.report --store $(if $(SESSION),"$(SESSION)")

lab: setup
	$(if $(SESSION),LRFCAL_SESSION="$(abspath $(SESSION))") .venv/bin/jupyter lab notebooks

clean:
	rm -rf .venv .pytest_cache .ruff_cache reports/*/ reports/.sessions
	find . -name __pycache__ -o -name .ipynb_checkpoints | xargs rm -rf
