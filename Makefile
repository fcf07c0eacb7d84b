# Every target calls idempotent commands: what the results folder holds already is not done again.
.DEFAULT_GOAL := help
.PHONY: help venv instances train-ko solve-baselines train-dpc solve-dpc bench report quick test lint clean

PYTHON  ?= python3
CASE    ?= 9bus
RESULTS ?= results/$(CASE)
SPLIT   ?= test
LIMIT   ?=
WORKERS ?= $(shell nproc 2>/dev/null || echo 2)
BIN     := .venv/bin
DED     := $(BIN)/ded-bench
STAMP   := .venv/installed
REGIMES := NO TO
POLICIES := ded-dpc-paper ded-dpc

CHOICE   = --case $(CASE) --split $(SPLIT) $(if $(LIMIT),--limit $(LIMIT))

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Settings: CASE=$(CASE) RESULTS=$(RESULTS) SPLIT=test|train|all LIMIT=n WORKERS=$(WORKERS)"

venv: $(STAMP)  ## make .venv with the pinned versions
$(STAMP): constraints.txt setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

instances: $(STAMP)  ## draw the 500 instances and their split (the same files every time)
	$(DED) instances --case $(CASE)

train-ko: $(STAMP)  ## identify the Koopman model from simulated trajectories
	$(DED) train-ko --case $(CASE) --results $(RESULTS)

solve-baselines: train-ko  ## solve and score DED and DED-KO in both regimes (SPLIT=all: all 500)
	$(DED) solve --method ded,ded-ko,ded-ko-knots --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS)

train-dpc: train-ko  ## train the DED-DPC policies on the training instances
	@for method in $(POLICIES); do printf '%s\n' $(REGIMES) | xargs -P $(WORKERS) -I REGIME \
	  $(DED) train-dpc --method $$method --regime REGIME --case $(CASE) --results $(RESULTS) $(TRAIN) || exit 1; \
	done

solve-dpc: train-dpc
	$(DED) solve --method ded-dpc-paper,ded-dpc,ded-dpc-refined --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS)

bench: solve-baselines solve-dpc  ## time each method alone on the machine
	$(DED) bench --case $(CASE) --results $(RESULTS) $(BENCH)

report: bench  ## everything that is missing, then Tables V and VI and the report
	$(DED) report --case $(CASE) --results $(RESULTS)

quick:  ## the same road with 4 instances and little training, about three minutes
	$(MAKE) report RESULTS=results/quick LIMIT=4 TRAIN="--seconds 20 --limit 40" BENCH="--instances 1"

test: $(STAMP)  ## lint, type check and tests
	$(BIN)/ruff check ded_bench tests
	$(BIN)/ruff format --check ded_bench tests
	$(BIN)/mypy
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)

clean:  ## remove the virtual environment, caches and results/quick (other results stay)
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache results/quick
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
