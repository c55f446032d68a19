# Every target sets up .venv by itself. Settings: make train TASK="bullet/hopper" SEEDS="0 1 2",
# make table-3 PRESET=thesis SEEDS="0 1", make plan TABLE="3 4" FIGURE=12.
PYTHON ?= python3
PRESET ?= cpu
TASK   ?= bullet/inverted_pendulum
SEEDS  ?= 0 1 2
OMEGA  ?= 0 0.1 0.2 0.3 0.4 0.5
SOURCE ?=
BACKEND ?= bullet
# What JAX computes on: cpu, cuda12, cuda13 (NVIDIA) or tpu. What was set up once stays.
ACCELERATOR ?= cpu
RESULTS ?= results
TABLE  ?=
FIGURE ?=
OUT    ?= runs/$(subst /,_,$(firstword $(TASK)))-$(PRESET)
ARGS   ?=

GRID    = --preset $(PRESET) --seeds $(SEEDS) --backend $(BACKEND) --results $(RESULTS)

# Every command starts processes that import the same modules, which are compiled once if that is
# kept: an empty value means that it may be.
export PYTHONDONTWRITEBYTECODE :=

VENV   := .venv
RUN    := $(VENV)/bin/python
STAMP   = $(VENV)/.installed-

ACCELERATORS := cpu cuda12 cuda13 tpu
ifneq ($(words $(ACCELERATOR)) $(filter $(ACCELERATORS),$(ACCELERATOR)),1 $(ACCELERATOR))
$(error ACCELERATOR is '$(ACCELERATOR)': expected one of $(ACCELERATORS))
endif
# The extra of an accelerator comes last; the CPU needs none.
ON := $(addprefix +,$(filter-out cpu,$(ACCELERATOR)))

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint hooks docs tables figures plan train sweep evaluate report bench bench-accelerator clean

help:  ## List the targets
	@grep -hE '^[a-z%-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/%/N/; s/:.*## /|/' | \
	  awk -F'|' '{printf "  make %-17s %s\n", $$1, $$2}'

# One stamp per set of extras, so that the demo installs no test tools. Modules are compiled when they
# are first imported: most never are, and compiling them all takes half of the set-up.
$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(STAMP)%: pyproject.toml constraints.txt | $(VENV)/bin/python
	@echo "setting up $(VENV) (a few minutes the first time)"
	@$(RUN) -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[$(subst +,$(comma),$*)]"
	@touch $@

comma := ,

# Runs what comes after it. Ctrl-C that ended in a saved run (130) is no error: with the trap, the
# shell lives to see it.
STOPPABLE = trap : INT; run() { echo "$$*"; "$$@" || { code=$$?; test $$code = 130 || exit $$code; }; }; run

setup: $(STAMP)bullet+brax+gymnasium+dev$(ON)  ## Set up .venv with everything

demo: $(STAMP)bullet+brax$(ON)  ## From a trained agent to fifteen that begin: what a transfer does (10 minutes)
	@$(STOPPABLE) $(RUN) -m experiments demo --results $(RESULTS) $(ARGS)

table-%: $(STAMP)$(BACKEND)$(ON)  ## Make Table N of the thesis from our runs: train what is missing, resume, show
	@$(STOPPABLE) $(RUN) -m experiments table $* $(GRID) $(ARGS)

figure-%: $(STAMP)$(BACKEND)$(ON)  ## Make Figure N of the thesis in the same way
	@$(STOPPABLE) $(RUN) -m experiments figure $* $(GRID) $(ARGS)

tables: $(STAMP)$(BACKEND)$(ON)  ## Make all tables
	@$(STOPPABLE) $(RUN) -m experiments table all $(GRID) $(ARGS)

figures: $(STAMP)$(BACKEND)$(ON)  ## Make all figures
	@$(STOPPABLE) $(RUN) -m experiments figure all $(GRID) $(ARGS)

plan: $(STAMP)$(BACKEND)$(ON)  ## Show the runs behind TABLE and FIGURE (numbers, or all) and what they will take
	$(RUN) -m experiments plan $(if $(TABLE),--table $(TABLE)) $(if $(FIGURE),--figure $(FIGURE)) $(GRID) $(ARGS)

# Weights that a test reads; the package's own dependencies are not needed for that.
$(VENV)/.weights: $(STAMP)bullet+brax+gymnasium+dev$(ON)
	@$(RUN) -m pip install --quiet --disable-pip-version-check --no-deps silero-vad==6.2.3
	@touch $@

test: $(STAMP)bullet+brax+gymnasium+dev$(ON) $(VENV)/.weights  ## Run the test suite (7 to 9 minutes)
	$(RUN) -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder $(ARGS)

lint: $(STAMP)bullet+brax+gymnasium+dev$(ON)  ## Check style and types
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

hooks: $(STAMP)bullet+brax+gymnasium+dev$(ON)  ## Let git check style and types before each commit
	$(RUN) -m pre_commit install

docs: $(STAMP)docs$(ON)  ## Build the pages and the reference of modules into site/
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet

train: $(STAMP)bullet+brax+gymnasium$(ON)  ## Train on TASK with SEEDS and PRESET into OUT (resumes what is there)
	@$(STOPPABLE) $(RUN) -m experiments train --task $(TASK) --seeds $(SEEDS) --preset $(PRESET) --out $(OUT) --resume $(ARGS)

sweep: $(STAMP)bullet+brax+gymnasium$(ON)  ## Transfer SOURCE to TASK: every OMEGA and seed of SEEDS, and a baseline
	@test -n "$(SOURCE)" || { echo 'error: name the source: make sweep TASK=bullet/hopper SOURCE=runs/source' >&2; exit 2; }
	@$(STOPPABLE) $(RUN) -m experiments train --task $(TASK) --seeds $(SEEDS) --preset $(PRESET) --source $(SOURCE) \
	  --omega $(OMEGA) --baseline --out $(OUT)-sweep --resume $(ARGS)

evaluate: $(STAMP)bullet+brax+gymnasium$(ON)  ## Play 5 episodes with every agent in OUT, with videos
	$(RUN) -m experiments evaluate $(OUT) --episodes 5 --video $(ARGS)

report: $(STAMP)bullet$(ON)  ## Print the table of OUT and draw its learning curves
	$(RUN) -m experiments report $(OUT)

bench: $(STAMP)bullet+brax+gymnasium+dev$(ON)  ## Run the benchmarks and write runs/benchmarks/table.md (an hour)
	$(RUN) -m benchmarks runs/benchmarks $(ARGS)

bench-accelerator: $(STAMP)brax$(ON)  ## Measure a card into runs/accelerator.md (20 minutes), with ACCELERATOR=cuda12
	@$(STOPPABLE) $(RUN) -m benchmarks accelerator $(ARGS)

clean:  ## Remove .venv and caches; runs/ and results/ stay
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache .hypothesis *.egg-info site
