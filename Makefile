# Every target calls idempotent commands: what the results folder holds already is not done again.
.DEFAULT_GOAL := help
.PHONY: help venv instances train-ko solve-baselines train-dpc solve-dpc bench report ac online suite quick radau starts models ablation certify test clean

PYTHON  ?= python3
CASE    ?= 9bus
CASES   ?= 9bus two-area 39bus 68bus 140bus
RESULTS ?= results/$(CASE)
SPLIT   ?= test
LIMIT   ?=
WORKERS ?= $(shell nproc 2>/dev/null || echo 2)
REGIME  ?=
KOOPMAN ?=
TRAIN   ?=
BENCH   ?=
BIN     := .venv/bin
DED     := $(BIN)/ded-bench
STAMP   := .venv/installed

# How many instances slow methods answer, on one case or on all others; 0: none. A smaller LIMIT comes first.
# Full DED: by Euler steps on 9bus, as in the paper; elsewhere by Radau collocation, and by Euler to compare.
# DED-KO over all points and Radau collocation refuse 140bus: their programs would take 15 and 13 GiB by estimate.
LIMIT_ded              ?= 0
LIMIT_ded_9bus         ?= all
LIMIT_ded_two-area     ?= 10
LIMIT_ded_39bus        ?= 10
LIMIT_ded-radau_9bus   ?= 0
LIMIT_ded-radau_39bus  ?= 20
LIMIT_ded-radau_68bus  ?= 10
LIMIT_ded-radau_140bus ?= 0
LIMIT_ded-ko_39bus     ?= 10
LIMIT_ded-ko_68bus     ?= 10
LIMIT_ded-ko_140bus    ?= 0
# How many instances are timed.
TIMED_39bus            ?= 5
TIMED_68bus            ?= 3
TIMED_140bus           ?= 2
TIMED                  ?= $(or $(TIMED_$(CASE)),10)

# How many scenarios of the closed loop slow methods operate; the sweeps take fewer.
SCENARIOS              ?= 20
SCENARIOS_ded_9bus     ?= 2
SCENARIOS_ded          ?= 0
SCENARIOS_ded-radau    ?= 0
SCENARIOS_ded-ko       ?= 0
SCENARIOS_ded-slp_9bus ?= 5
SCENARIOS_sweep        ?= 10
SCENARIOS_period       ?= 5
SCENARIOS_real-time_39bus ?= 11

BASELINES := ded ded-radau ded-slp ded-ko ded-ko-knots
MODELS    := linear koopman-paper $(if $(filter 9bus,$(CASE)),koopman-single,trajectory)
# On 39bus one program of ded-ko on `linear` was not solved after 17 minutes.
PATIENCE  := $(if $(filter 9bus,$(CASE)),, --time-limit 120)
# Policies: on 9bus trained, the paper's too; elsewhere the one with shared weights, trained if TRAIN asks, or
# taken from the reference run.
POLICIES  := $(if $(filter 9bus,$(CASE)),ded-dpc-paper ded-dpc,ded-dpc-shared)
REFINED   := $(if $(filter 9bus,$(CASE)),ded-dpc-refined,ded-dpc-shared-refined)
TRAINED   := $(or $(filter 9bus,$(CASE)),$(TRAIN))
# How long our policy trains unless TRAIN says so; docs/results.md tells what more brings.
TRAIN_ded-dpc_9bus ?= --seconds 420
ANSWERING := $(or $(TRAINED),$(wildcard results/$(CASE)-reference/policies))

# What `make quick` times: not full DED, which takes a minute to set up, nor the many settings of ded-dpc-refined.
QUICK_BENCH := ed,ded-slp,ded-ko,ded-ko-knots,ded-dpc-paper,ded-dpc

define NEWLINE


endef
ONLY     = $(if $(REGIME),--regime $(REGIME))
LIMITED  = $(or $(LIMIT_$(1)_$(CASE)),$(LIMIT_$(1)),all)
FEWEST   = $(firstword $(shell printf '%s\n' $(filter-out all,$(LIMIT) $(call LIMITED,$(1))) | sort -n))
CHOICE   = --case $(CASE) --split $(SPLIT) $(ONLY) $(if $(FEWEST),--limit $(FEWEST)) \
  --workers $(WORKERS) --out $(RESULTS)
# $(call SOLVE,methods,options): a command for each method, none for one that is limited to 0 instances
SOLVE    = $(foreach m,$(1),$(if $(filter-out 0,$(call LIMITED,$m)),$(DED) solve --method $m$(2) \
  $(call CHOICE,$m)$(NEWLINE)))
# $(call OPERATE,method,study): a command of the closed loop; a study, if named, tells how many scenarios
SCENES   = $(or $(SCENARIOS_$(1)_$(CASE)),$(SCENARIOS_$(1)),$(SCENARIOS))
OPERATE  = $(DED) online --method $(1) --case $(CASE) $(ONLY) --scenarios $(call SCENES,$(or $(2),$(1))) \
  --workers $(WORKERS) --out $(RESULTS)
LATENCIES  := 0,0.03,0.1,0.3,1,3,7,15,30
SURROGATE  := $(if $(filter 9bus,$(CASE)),,--model trajectory)
# Real-time iterations, on two-area with reserve, too: on the larger grids no load's ramp is fast enough to ask for one.
COMMA      := ,
REAL_TIME  := --settings real-time$(if $(filter two-area,$(CASE)),$(COMMA)reserve) --model trajectory
# What is swept: knots that keep their places from plan to plan; the margin depends on the grid (docs/online.md).
KNOTS      := --settings $(if $(filter 9bus,$(CASE)),receding,receding-wide) $(SURROGATE)
# The sweeps: on 9bus by knots that keep their places, elsewhere by the refined policy.
SWEEP       = $(call OPERATE,$(if $(filter 9bus,$(CASE)),ded-ko-knots,$(REFINED)),sweep) $(if $(filter 9bus,$(CASE)),$(KNOTS))
OPERATED   := $(if $(ANSWERING),$(POLICIES) $(REFINED))
VALIDATION = $(subst --split $(SPLIT),--split validation,$(CHOICE))

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Settings: CASE=$(CASE) RESULTS=$(RESULTS) SPLIT=test|train|all REGIME=r LIMIT=n WORKERS=$(WORKERS)"
	@echo "  CASE: a shipped case ($(CASES)) or a folder"
	@echo "  Fewer instances for slow methods: $(foreach v,$(sort $(filter LIMIT_%,$(.VARIABLES))),$v=$($v))"
	@echo "  Instances that are timed: TIMED=$(TIMED)"

venv: $(STAMP)  ## make .venv with the pinned versions
$(STAMP): constraints.txt setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

instances: $(STAMP)  ## draw the instances and their split (the same files every time)
	$(DED) instances --case $(CASE)

train-ko: $(STAMP)  ## identify the Koopman model from simulated trajectories
	$(DED) train-ko --case $(CASE) --results $(RESULTS) $(KOOPMAN)

solve-baselines: train-ko  ## solve and score static dispatch, DED and DED-KO in all regimes (SPLIT=all: all instances)
	$(call SOLVE,ed, --settings '*')
	$(call SOLVE,$(BASELINES))
	$(if $(filter 9bus,$(CASE)),$(call SOLVE,ded, --settings accelerated),$(call \
	  SOLVE,ded-ko-knots, $(REAL_TIME)))

radau: train-ko  ## full DED by Radau collocation: the accurate reference
	$(DED) solve --method ded-radau $(CHOICE)

starts: train-ko  ## ten instances of full DED from three other starting points: are its optima the same?
	$(DED) solve --method ded --settings 'start-*' $(CHOICE) --limit 10

train-dpc: train-ko  ## train the policies on the training instances
	$(foreach m,$(POLICIES),$(DED) train-dpc --method $m --case $(CASE) $(ONLY) --results $(RESULTS) \
	  --workers $(WORKERS) $(or $(TRAIN),$(TRAIN_$m_$(CASE)))$(NEWLINE))

solve-dpc: $(if $(TRAINED),train-dpc,train-ko)  ## solve and score with the policies
	$(call SOLVE,$(POLICIES))
	$(call SOLVE,$(REFINED), --settings '*')

models: solve-baselines  ## DED-KO on other models of the dynamics, and the errors of each
	$(DED) train-ko --kind koopman-paper --case $(CASE) --results $(RESULTS)
	$(foreach model,$(MODELS),$(call SOLVE,ded-ko ded-ko-knots, --model $(model)$(PATIENCE)))
	$(DED) rollouts --case $(CASE) --results $(RESULTS)

ablation: models  ## short trainings of DED-DPC, each with one thing changed, judged on validation instances
	$(DED) solve --method ded-ko-knots $(VALIDATION)
	$(DED) train-dpc --method ded-dpc --settings 'study*' --case $(CASE) $(ONLY) --results $(RESULTS) --workers $(WORKERS)
	$(DED) solve --method ded-dpc --settings 'study*' $(VALIDATION)
	for model in $(filter-out trajectory,$(MODELS)); do \
	  $(DED) train-dpc --settings study --method ded-dpc --model $$model --case $(CASE) $(ONLY) \
	    --results $(RESULTS) --workers $(WORKERS) || exit 1; \
	  $(DED) solve --method ded-dpc --settings study --model $$model $(VALIDATION) || exit 1; done

certify: train-dpc  ## certify DED-DPC on 10,000 fresh instances per regime
	$(DED) certify --method $(lastword $(filter-out %-paper,$(POLICIES))) --case $(CASE) $(ONLY) --results $(RESULTS) --workers $(WORKERS)

bench: solve-baselines $(if $(ANSWERING),solve-dpc) $(if $(filter 9bus,$(CASE)),,models)  ## time each method alone on the machine
	$(DED) bench --case $(CASE) --results $(RESULTS) --instances $(TIMED) $(BENCH)

report: bench  ## everything that is missing, then the tables and the report
	$(DED) report --case $(CASE) --results $(RESULTS)

# AC cannot carry many instances: their rows say so, and commands end with 1.
ac: solve-baselines  ## the full AC network: methods that know it, then all kept schedules judged on it
	$(DED) train-ko --truth ac --case $(CASE) --results $(RESULTS)
	-$(call SOLVE,ded-slp, --settings ac)
	-$(call SOLVE,ded-ko-knots, --model trajectory-ac)
	$(if $(filter two-area,$(CASE)),$(DED) train-ko --truth ac --kind swing --case $(CASE) --results $(RESULTS))
	$(if $(filter two-area,$(CASE)),-$(call SOLVE,ded-ko-knots, --settings swing-ac))
	-$(DED) score --case $(CASE) --results $(RESULTS) --truth ac
	$(DED) report --case $(CASE) --results $(RESULTS)

online: train-ko  ## the closed loop: all methods at their own latency, then sweeps over latency, forecast and period
	for s in 1 10; do $(call OPERATE,ed) --settings $${s}s --period $$s || exit 1; done
	$(call OPERATE,ed) --period 60
	$(foreach m,ded-slp ded-ko-knots $(OPERATED) ded,$(if $(filter-out 0,$(call SCENES,$m)),$(call \
	  OPERATE,$m) $(if $(filter ded-ko-knots,$m),$(SURROGATE))$(NEWLINE)))
	$(call OPERATE,ded-ko-knots) $(KNOTS)
	$(call OPERATE,ded-ko-knots) $(KNOTS) --latency 0 --forecast perfect
	$(if $(SURROGATE),$(call OPERATE,ded-ko-knots,real-time) $(REAL_TIME) --period 0.1)
	$(foreach m,$(OPERATED),$(call OPERATE,$m,period) --period 0.1$(NEWLINE))
	$(call OPERATE,ded-ko-knots,period) $(KNOTS) --period 0.1
	$(SWEEP) --latency $(LATENCIES)
	$(SWEEP) --latency 0,1,7,30 --forecast perfect,worse,persistence
	$(SWEEP) --latency 1,7,30 --state present

suite:  ## the reports of all cases, then one page over them
	for case in $(CASES); do $(MAKE) report CASE=$$case RESULTS=results/$$case || exit 1; done
	$(DED) overview --results $(CASES:%=results/%)

quick:  ## the same road with 4 instances (2 for full DED) and little training, about four minutes
	$(MAKE) report RESULTS=results/quick LIMIT=4 LIMIT_ded_9bus=2 KOOPMAN="--count 24" \
	  TRAIN="--seconds 8 --limit 40" TIMED=1 BENCH="--repeats 1 --method $(QUICK_BENCH)"

test: $(STAMP)  ## lint, type check and tests
	$(BIN)/ruff check ded_bench tests examples
	$(BIN)/ruff format --check ded_bench tests examples
	$(BIN)/mypy
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)

clean:  ## remove the virtual environment, caches and results/quick (other results stay)
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache results/quick
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
