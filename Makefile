# Every target calls idempotent commands: what the results folder holds already is not done again.
.DEFAULT_GOAL := help
.PHONY: help venv instances train-ko solve-baselines train-dpc solve-dpc bench report quick radau starts models ablation certify test clean

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
MODELS := linear koopman-single koopman-paper
STEPS  := steps25 steps100 steps1000
STUDIES := study study-narrow study-wide study-near study-shallow study-one-stage study-three-stages \
  study-no-response study-no-dispatch study-no-bends study-no-prior study-raw study-constant \
  study-batch32 study-batch512 study-fresh4000

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

solve-baselines: train-ko  ## solve and score static dispatch, DED and DED-KO in both regimes (SPLIT=all: all 500)
	$(DED) solve --method ded,ed,ded-ko,ded-ko-knots --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS)
	$(DED) solve --method ded --settings accelerated --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS)
	for every in 10s 1s; do $(DED) solve --method ed --settings $$every --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS) || exit 1; done

radau: train-ko  ## full DED by Radau collocation: the accurate reference
	$(DED) solve --method ded-radau --regime NO,TO $(CHOICE) --workers $(WORKERS) --out $(RESULTS)

starts: train-ko  ## ten instances of full DED from three other starting points: are its optima the same?
	for start in ed ko random; do $(DED) solve --method ded --settings start-$$start --regime NO,TO \
	  --case $(CASE) --split $(SPLIT) --limit 10 --workers $(WORKERS) --out $(RESULTS) || exit 1; done

train-dpc: train-ko  ## train the DED-DPC policies on the training instances
	@for method in $(POLICIES); do printf '%s\n' $(REGIMES) | xargs -P $(WORKERS) -I REGIME \
	  $(DED) train-dpc --method $$method --regime REGIME --case $(CASE) --results $(RESULTS) $(TRAIN) || exit 1; \
	done

solve-dpc: train-dpc
	$(DED) solve --method ded-dpc-paper,ded-dpc,ded-dpc-refined --regime NO,TO $(CHOICE) \
	  --workers $(WORKERS) --out $(RESULTS)
	for steps in $(STEPS); do $(DED) solve --method ded-dpc-refined --settings $$steps --regime NO,TO \
	  $(CHOICE) --workers $(WORKERS) --out $(RESULTS) || exit 1; done

models: solve-baselines  ## DED-KO on other Koopman models, and the errors of each model
	$(DED) train-ko --kind koopman-paper --case $(CASE) --results $(RESULTS)
	for model in $(MODELS); do $(DED) solve --method ded-ko,ded-ko-knots --regime NO,TO --model $$model \
	  $(CHOICE) --workers $(WORKERS) --out $(RESULTS) || exit 1; done
	$(DED) rollouts --case $(CASE) --results $(RESULTS)

ablation: models  ## short trainings of DED-DPC in TO, each with one thing changed, and DED-DPC on other models
	printf '%s\n' $(STUDIES) | xargs -P $(WORKERS) -I NAME \
	  $(DED) train-dpc --settings NAME --regime TO --case $(CASE) --results $(RESULTS)
	printf '%s\n' $(MODELS) | xargs -P $(WORKERS) -I MODEL \
	  $(DED) train-dpc --settings study --model MODEL --regime TO --case $(CASE) --results $(RESULTS)
	for name in $(STUDIES); do $(DED) solve --method ded-dpc --settings $$name --regime TO \
	  $(CHOICE) --workers $(WORKERS) --out $(RESULTS) || exit 1; done
	for model in $(MODELS); do $(DED) solve --method ded-dpc --settings study --model $$model --regime TO \
	  $(CHOICE) --workers $(WORKERS) --out $(RESULTS) || exit 1; done

certify: train-dpc  ## certify DED-DPC on 10,000 fresh instances per regime
	$(DED) certify --case $(CASE) --results $(RESULTS) --workers $(WORKERS)

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
