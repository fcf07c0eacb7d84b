# Every target calls idempotent commands: what the results folder holds already is not done again.
.DEFAULT_GOAL := help
.PHONY: help venv instances train-ko solve-baselines train-dpc solve-dpc bench report quick radau starts solve-starts models ablation certify test clean

PYTHON  ?= python3
CASE    ?= 9bus
RESULTS ?= results/$(CASE)
SPLIT   ?= test
LIMIT   ?=
WORKERS ?= $(shell nproc 2>/dev/null || echo 2)
BIN     := .venv/bin
DED     := $(BIN)/ded-bench
STAMP   := .venv/installed
MODELS  := linear koopman-single koopman-paper
REGIME  ?=

ONLY     = $(if $(REGIME),--regime $(REGIME))
CHOICE   = --case $(CASE) --split $(SPLIT) $(ONLY) $(if $(LIMIT),--limit $(LIMIT)) \
  --workers $(WORKERS) --out $(RESULTS)
VALIDATION = --case $(CASE) --split validation $(ONLY) $(if $(LIMIT),--limit $(LIMIT)) \
  --workers $(WORKERS) --out $(RESULTS)

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Settings: CASE=$(CASE) RESULTS=$(RESULTS) SPLIT=test|train|all REGIME=r LIMIT=n WORKERS=$(WORKERS)"

venv: $(STAMP)  ## make .venv with the pinned versions
$(STAMP): constraints.txt setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

instances: $(STAMP)  ## draw the 500 instances and their split (the same files every time)
	$(DED) instances --case $(CASE)

train-ko: $(STAMP)  ## identify the Koopman model from simulated trajectories
	$(DED) train-ko --case $(CASE) --results $(RESULTS)

solve-baselines: train-ko  ## solve and score static dispatch, DED and DED-KO in all regimes (SPLIT=all: all instances)
	$(DED) solve --method ded,ed,ded-ko,ded-ko-knots $(CHOICE)
	$(DED) solve --method ded --settings accelerated $(CHOICE)
	$(DED) solve --method ed --settings '1*s' $(CHOICE)

radau: train-ko  ## full DED by Radau collocation: the accurate reference
	$(DED) solve --method ded-radau $(CHOICE)

starts: train-ko  ## ten instances of full DED from three other starting points: are its optima the same?
	$(MAKE) solve-starts LIMIT=10

solve-starts:
	$(DED) solve --method ded --settings 'start-*' $(CHOICE)

train-dpc: train-ko  ## train the policies on the training instances
	$(DED) train-dpc --case $(CASE) $(ONLY) --results $(RESULTS) --workers $(WORKERS) $(TRAIN)

solve-dpc: train-dpc
	$(DED) solve --method ded-dpc-paper,ded-dpc,ded-dpc-refined $(CHOICE)
	$(DED) solve --method ded-dpc-refined --settings 'steps*' $(CHOICE)

models: solve-baselines  ## DED-KO on other Koopman models, and the errors of each model
	$(DED) train-ko --kind koopman-paper --case $(CASE) --results $(RESULTS)
	for model in $(MODELS); do $(DED) solve --method ded-ko,ded-ko-knots --model $$model $(CHOICE) || exit 1; done
	$(DED) rollouts --case $(CASE) --results $(RESULTS)

ablation: models  ## short trainings of DED-DPC, each with one thing changed, judged on validation instances
	$(DED) solve --method ded-ko-knots $(VALIDATION)
	$(DED) train-dpc --settings 'study*' --case $(CASE) $(ONLY) --results $(RESULTS) --workers $(WORKERS)
	$(DED) solve --method ded-dpc --settings 'study*' $(VALIDATION)
	for model in $(MODELS); do \
	  $(DED) train-dpc --settings study --method ded-dpc --model $$model --case $(CASE) $(ONLY) \
	    --results $(RESULTS) --workers $(WORKERS) || exit 1; \
	  $(DED) solve --method ded-dpc --settings study --model $$model $(VALIDATION) || exit 1; done

certify: train-dpc  ## certify DED-DPC on 10,000 fresh instances per regime
	$(DED) certify --case $(CASE) $(ONLY) --results $(RESULTS) --workers $(WORKERS)

bench: solve-baselines solve-dpc  ## time each method alone on the machine
	$(DED) bench --case $(CASE) --results $(RESULTS) $(BENCH)

report: bench  ## everything that is missing, then Tables V and VI and the report
	$(DED) report --case $(CASE) --results $(RESULTS)

quick:  ## the same road with 4 instances and little training, about ten minutes
	$(MAKE) report RESULTS=results/quick LIMIT=4 TRAIN="--seconds 20 --limit 40" BENCH="--instances 1 --repeats 1"

test: $(STAMP)  ## lint, type check and tests
	$(BIN)/ruff check ded_bench tests
	$(BIN)/ruff format --check ded_bench tests
	$(BIN)/mypy
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)

clean:  ## remove the virtual environment, caches and results/quick (other results stay)
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache results/quick
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
