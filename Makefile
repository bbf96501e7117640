# Everything a person or the continuous integration does here. Needs Python 3.11 with its venv module, and make.

PYTHON ?= python3.11
ENVIRONMENT := .venv
BIN := $(ENVIRONMENT)/bin
INSTALLED := $(ENVIRONMENT)/.installed
COMPILED := $(CURDIR)/build/compiled
BUILT := $(COMPILED)/.built
GENERATED := build/.generated
# In the environment variable as well, because pip builds our own package with what it finds there alone.
PIP := PIP_CONSTRAINT=$(CURDIR)/constraints.txt $(BIN)/python -m pip install -qq --disable-pip-version-check --constraint constraints.txt
TOOLS := build/tools/.installed

.PHONY: help compiled demo run search quick test test-long test-versions test-compiled test-fleet lint types contracts check audit bill manifests mutation docs environment constraints hashes clean

help:  ## lists the targets
	@grep -hE '^[a-z-]+:.*##' Makefile | sed 's/:.*##/\t/' | expand -t 14

# Both run the source: the decisions are compiled by `environment`, and one car needs no more.
demo: environment  ## two minutes: a steering is bent while the car drives, found, and corrected by your click
	@$(BIN)/safedpa demo

run: environment  ## starts the closed loop with its live dashboard; Ctrl-C ends it
	@echo "Starting robot, services and dashboard: 5 to 15 s. The address of the live view follows. Ctrl-C ends everything."
	@$(BIN)/safedpa up --robot car --load chair --seed 4

# A copy of the product whose innermost modules are compiled, where a C compiler is at hand: what `pip install` gives.
# What is edited or tested is the source itself, so the copy is made again when any of it is newer.
$(BUILT): $(INSTALLED) hatch_build.py $(shell find shared services sim/safedpa_sim -type f -not -name '*.pyc')
	@echo "Compiling the modules of every decision into build/compiled; this takes a minute when they have changed."
	@rm -rf $(COMPILED)
	@$(PIP) --no-deps --target $(COMPILED) . || { rm -rf $(COMPILED); mkdir -p $(COMPILED); }
	@PYTHONPATH=$(COMPILED) $(BIN)/python -c 'from safedpa.compiled import *; compiled_modules() or print("Nothing could be compiled (is there a C compiler?): the loop runs from Python source, and a decision takes ten times as long.")'
	@touch $@

compiled: $(BUILT)  ## a copy of the product as a wheel has it, its innermost modules compiled: for test-compiled

# One more than two cores: half of the time a test waits for services, browsers and robots that drive in real time.
TESTERS ?= 3

# Bytecode is kept, whatever the environment says: hundreds of processes would each compile all that they import.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --numprocesses $(TESTERS) --dist loadfile --durations 20

quick: environment  ## the tests that your change touches, nearest first, within half a minute
	@$(BIN)/python tests/tools/quick.py

test: environment  ## the tests that one waits for, on two cores four minutes
	@$(PYTEST) -m "not long"

test-long: environment  ## all other tests: trainings, experiments, searches, browsers, processes
	@$(PYTEST) -m long

# Every day another seed; what it finds is kept as an @example of its test.
SEED ?= $(shell date +%Y%m%d)
PROPERTIES ?= tests

search: environment  ## property tests with ten times the examples, from today's seed or SEED=N, of PROPERTIES=tests/...
	@echo "seed $(SEED)"
	@HYPOTHESIS_PROFILE=search $(BIN)/pytest -q --numprocesses 2 --dist load -m hypothesis --hypothesis-seed $(SEED) $(PROPERTIES)

test-fleet: environment  ## a fleet of containers: faults, intruders; installs docker on Debian
	@deploy/test-fleet

# Of those that stand in for a compiled class by one of their own, none is among them.
TESTS_OF_COMPILED := tests/safety tests/native/test_decisions.py tests/dynamics/test_recorded_step.py \
	tests/policy/test_fast_policy.py tests/policy/test_goal_seeker.py tests/robots/test_robot_physics.py \
	$(filter-out %/test_filtered_robot.py %/test_filtered_robot_standing.py,$(wildcard tests/internals/safety/test_*.py)) \
	$(addprefix tests/bus/test_,coalescing.py handshake.py inbox.py inbox_receiver.py joint_transport.py service_loop.py robot_slot.py)

test-versions: environment  ## quick tests of the library on every other supported Python that is installed
	@$(BIN)/python deploy/python_versions.py

test-compiled: $(BUILT)  ## the tests of the compiled modules, on a wheel that has them; needs a C compiler
	@PYTHONPATH=$(COMPILED) $(BIN)/python -c 'from safedpa.compiled import *; assert compiled_modules() == MODULES'
	@PYTHONPATH=$(COMPILED) $(BIN)/pytest -q --numprocesses $(TESTERS) --dist loadfile $(TESTS_OF_COMPILED)

lint: environment  ## ruff: rules and format; codespell: spelling, and the words that the project does not write
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/codespell -D - -D tests/architecture/dictionary.txt shared services sim deploy docs *.md Makefile
	@$(BIN)/codespell -D tests/architecture/dictionary.txt tests

types: environment  ## mypy, strict
	@$(BIN)/mypy

contracts: environment  ## import-linter: imports go down only, services never import each other
	@$(BIN)/lint-imports

check: lint types contracts test test-long  ## all of it

docs: environment  ## the pages as a site, in build/site: open index.html there, no server and no network needed
	@$(BIN)/python docs/generate.py --check
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "Built: build/site/index.html"

environment: $(INSTALLED) $(GENERATED)  ## creates .venv, or brings it up to date; compiles decisions to C

# Torch comes first, by its exact version: where a build for the processor alone is at hand, that one is taken.
# Links, not copies, of the product and its laboratory are installed, so the environment changes only with these files.
# Bytecode is made next to the installing, by the other core: pip would make it file after file.
BYTECODE := $(BIN)/python -m compileall -qq -j 2 $(ENVIRONMENT)/lib || true
$(INSTALLED): pyproject.toml sim/pyproject.toml constraints.txt constraints-hashes.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' \
		|| { echo "$(PYTHON): wanted Python 3.11; say make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "Installing into $(ENVIRONMENT); the first time this takes two to three minutes."
	@$(PYTHON) -m venv $(ENVIRONMENT)
	@mkdir -p build
	@echo "  1 of 3: torch, the largest download"
	@$(PIP) --no-compile --report build/torch.json torch==2.13.0
	@echo "  2 of 3: the other $$(grep -c == constraints.txt) packages"
	@($(BYTECODE)) & $(PIP) --no-compile --report build/packages.json --editable '.[test,lint]' --editable sim || exit 1; wait; $(BYTECODE)
	@echo "  3 of 3: compares the hash of each file with the pinned ones"
	@$(PYTHON) deploy/check_hashes.py build/torch.json build/packages.json
	@touch $@

# Into the user's cache; a second where nothing has changed. Without a compiler a line says that Python decides.
$(GENERATED): $(INSTALLED) $(shell find shared/safedpa -type f -not -name '*.pyc')
	@echo "Compiling the decisions of all robots to C; up to half a minute if they have changed."
	@$(BIN)/python -m safedpa.generate || true
	@mkdir -p build
	@touch $@

# What checks the project and is no part of it: in an environment of its own, each file compared with its hash.
$(TOOLS): deploy/tools.txt
	@rm -rf build/tools
	@$(PYTHON) -m venv build/tools
	@build/tools/bin/python -m pip install -qq --disable-pip-version-check --require-hashes --requirement deploy/tools.txt
	@touch $@

manifests: environment $(TOOLS)  ## what deploy/kubernetes_region.py writes, compared with Kubernetes' schemas
	@rm -rf build/manifests
	@$(BIN)/safedpa certificates build/manifests/keys --robot robot-1 --robot robot-2 >/dev/null
	@$(BIN)/python deploy/kubernetes_region.py --robots 2 --certificates build/manifests/keys --robots-from 10.20.0.0/16 \
		> build/manifests/region.yaml
	@build/tools/bin/kubernetes-validate --strict --quiet build/manifests/region.yaml
	@rm -rf build/manifests

# The tests run in the project's environment.
mutation: environment $(TOOLS)  ## mutates MODULE=shared/... and runs TESTS=tests/... for each mutant; use a clone
	@mkdir -p build/mutation
	@sed -e 's#MODULE#$(MODULE)#' -e 's#TESTS#$(TESTS)#' tests/tools/mutation.toml > build/mutation/session.toml
	@build/tools/bin/cosmic-ray init --force build/mutation/session.toml build/mutation/session.sqlite
	@build/tools/bin/cr-filter-operators build/mutation/session.sqlite build/mutation/session.toml
	@build/tools/bin/cosmic-ray exec build/mutation/session.toml build/mutation/session.sqlite
	@build/tools/bin/cr-report --surviving-only --show-diff build/mutation/session.sqlite

bill: environment $(TOOLS)  ## what is installed, with licences, as a bill of materials (CycloneDX): build/sbom.json
	@build/tools/bin/cyclonedx-py environment --pyproject pyproject.toml --output-file build/sbom.json $(ENVIRONMENT)
	@echo "Written: build/sbom.json"

audit: $(TOOLS)  ## fails on a known hole in what is pinned that deploy/waivers.toml does not name; asks the public index
	@$(PYTHON) deploy/audit.py build/tools/bin/pip-audit constraints-hashes.txt deploy/tools.txt

constraints:  ## writes constraints.txt again from the newest releases
	@rm -rf build/constraints
	@$(PYTHON) -m venv build/constraints
	@build/constraints/bin/python -m pip install --quiet torch==2.13.0
	@build/constraints/bin/python -m pip install --quiet --editable '.[test,lint]' --editable 'sim[peers]' hatchling==1.32.4
	@build/constraints/bin/python -m pip freeze --all --exclude safedpa --exclude safedpa-lab --exclude pip \
		| sed 's/+cpu$$//' > constraints.txt
	@rm -rf build/constraints
	@$(MAKE) --no-print-directory hashes

COMPILE := build/tools/bin/uv pip compile --quiet --no-header --generate-hashes --python-version 3.11 --output-file
hashes: $(TOOLS)  ## writes the hashes of what constraints.txt and deploy/tools.in pin, from the index
	@$(COMPILE) constraints-hashes.txt --no-deps --no-annotate constraints.txt
	@$(COMPILE) deploy/tools.txt deploy/tools.in

clean:  ## removes everything that was made here, the environment included
	@rm -rf $(ENVIRONMENT) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	@find shared sim services tests -name __pycache__ -type d -prune -exec rm -rf {} +
