# make setup  everything the others need, kernels compiled; then `. .build/setup.sh` for a shell with it
# make scan   a simulated scan: cloud, picture, error against the truth
# make report the paper's experiments again: report/index.html
# make tradeoff speed against error again, and the table of docs/tradeoff.md from it
# make faults the fault table of docs/faults.md again, from its tests
# make docs   the documentation as a site: .build/site/index.html
# make reference docs/interfaces.md and config/sros2 again, from the nodes
# make test   every test
# make test-floor the pure tests with the oldest versions, those of Ubuntu 24.04, in a venv of their own
# make quick  the tests of the pure parts: no processes, no ROS
# make picture docs/architecture.png again
# make moving-picture docs/face.gif again: a simulated scan of a face as it grows
# make check  lint, types, import contracts
#
# Everything is set up on the way: .venv with pinned packages, interfaces in .build/install.
# Where a ROS 2 distribution is sourced (ROS_DISTRO is set) it is used and no ROS wheel is installed.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
# What needs nothing of each other goes side by side.
ifeq ($(MAKELEVEL)$(filter -j%,$(MAKEFLAGS)),0)
MAKEFLAGS += --jobs=3
endif
ifeq ($(filter test,$(MAKECMDGOALS))$(TEST),test)
MAKEFLAGS += --output-sync=line
endif
# Containers often set it; every process would compile numba and all the rest again, for a second.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
JOBS ?= $(shell nproc)
ROOT := $(CURDIR)
VENV := $(ROOT)/.venv
BUILD := $(ROOT)/.build
PREFIX := $(BUILD)/install
SETUP := $(BUILD)/setup.sh
# Most modules are never imported; Python compiles those that are.
PIP := $(VENV)/bin/pip --disable-pip-version-check install --quiet --no-compile --constraint requirements/constraints.txt
ENTER := . $(SETUP) &&

ifdef ROS_DISTRO
VENV_FLAGS := --system-site-packages
RUN_REQUIREMENTS := -r requirements/run.txt
UNDERLAY := $(AMENT_PREFIX_PATH)
else
VENV_FLAGS :=
RUN_REQUIREMENTS := -r requirements/run.txt -r requirements/ros.txt
UNDERLAY := $(VENV)
endif
# Message packages that the underlay lacks are built from external_msgs/.
provided = $(strip $(foreach prefix,$(subst :, ,$(UNDERLAY)),$(wildcard $(prefix)/share/$(1)/package.xml)))
EXTERNAL := $(foreach package,event_camera_msgs tf2_msgs,$(if $(call provided,$(package)),,$(package)))

INTERFACES := CMakeLists.txt package.xml $(wildcard msg/* srv/* action/* cmake/* config/* launch/*) \
              $(shell find external_msgs -type f)

.PHONY: help setup scan report docs tradeoff faults reference picture moving-picture test test-pure test-devices test-scans test-nodes test-rest test-floor quick check lint format types contracts clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

setup: $(SETUP) $(BUILD)/kernels.stamp

scan: $(SETUP) $(BUILD)/kernels.stamp
	@$(ENTER) eschorty scan --out scan $(SCAN)

report: $(SETUP)
	@$(ENTER) eschorty report --out report $(REPORT)

tradeoff: $(SETUP)
	@$(ENTER) eschorty report --out report --only tradeoff
	@$(ENTER) python -m eschorty_experiments.tradeoff_page report/tradeoff-changes.csv docs/tradeoff.md

DOCS := $(BUILD)/docs

docs: $(SETUP) $(DOCS)/stamp
	@$(ENTER) $(DOCS)/bin/python -m sphinx --quiet --fail-on-warning --keep-going docs $(BUILD)/site
	@echo "$(BUILD)/site/index.html"

# An environment of its own, since Sphinx needs another docutils than ROS; the package's own comes after it.
$(DOCS)/stamp: requirements/docs.txt $(BUILD)/run.stamp
	@echo "Installing Sphinx into $(DOCS)"
	@$(PYTHON) -m venv --clear $(DOCS)
	@$(DOCS)/bin/pip --disable-pip-version-check install --quiet -r $<
	@$(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
	  > "$$($(DOCS)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/run.pth"
	@touch $@

faults: $(SETUP)
	@$(ENTER) python docs/faults.py

reference: $(SETUP)
	@$(ENTER) python docs/interfaces.py && python docs/policies.py

# Nodes and devices that need no kernels go beside compiling or the pure parts, which share the cores, the
# longest first; then whole scans go beside the rest. The emulated bench runs in real time, and a computer
# that stalls fails a scan: what failed runs once more, all of it after a test that hung.
PURE := $(addprefix test/,experiments core live control simulation stability surfaces report viewer \
          cli/test_calibrate_command.py)
DEVICES := $(addprefix test/,hardware nodes/laser nodes/stage)
SCANS := $(addprefix test/nodes/,scanner test_hostile_messages.py)
NODES := test/launch test/nodes
REST := test $(addprefix --ignore=,$(PURE) $(DEVICES) $(SCANS) $(NODES))
# Threads of libraries that wait for each other by spinning take five times as long beside other work.
test-pure test-devices test-scans test-nodes test-rest quick: export OMP_NUM_THREADS := 1
# Freed arrays stay with the process: to clear what the system gives out again is a tenth of the time.
test-pure quick: export MALLOC_MMAP_THRESHOLD_ := 4294967296
test-pure quick: export MALLOC_TRIM_THRESHOLD_ := 4294967296
test-%: run = pytest $(tests) -o cache_dir=$(BUILD)/$@
test-devices: tests := $(DEVICES)
test-scans: tests := $(SCANS)
test-nodes: tests := $(NODES) $(addprefix --ignore=,$(DEVICES) $(SCANS))
test-rest: tests := $(REST)
ifdef TEST
test: $(SETUP) $(BUILD)/test.stamp
	@$(ENTER) pytest $(TEST)
else
test: test-scans test-nodes test-rest

test-scans test-nodes test-rest: test-pure test-devices

test-pure: $(SETUP) $(BUILD)/test.stamp $(BUILD)/kernels.stamp
	@$(ENTER) pytest --numprocesses $(JOBS) $(PURE)

test-devices test-scans test-nodes test-rest: $(SETUP) $(BUILD)/test.stamp
	@$(ENTER) $(run) --cache-clear || { (($$? == 1)) && echo "Once more:" && $(run) --last-failed; }
endif

quick: $(SETUP) $(BUILD)/test.stamp $(BUILD)/kernels.stamp
	@$(ENTER) pytest --numprocesses $(JOBS) --dist worksteal test/core test/live test/control \
	  --ignore=test/core/base/test_kernel.py

FLOOR_PYTHON ?= $(firstword $(wildcard /usr/bin/python3.11 /usr/bin/python3.12) $(PYTHON))
FLOOR := $(BUILD)/floor

test-floor: $(FLOOR)/stamp
	@export NUMBA_CACHE_DIR=$(FLOOR)/numba PYTHONPATH="$(ROOT):$(ROOT)/experiments"; \
	$(FLOOR)/bin/python -c 'from eschorty_ros.cli import main; main(["compile"])'; \
	$(FLOOR)/bin/python -m pytest --numprocesses $(JOBS) $(addprefix test/,core live control simulation stability)

$(FLOOR)/stamp: requirements/floor.txt
	@echo "Installing the oldest versions into $(FLOOR)"
	@$(FLOOR_PYTHON) -m venv --clear $(FLOOR)
	@$(FLOOR)/bin/pip --disable-pip-version-check install --quiet -r $<
	@touch $@

picture: $(BUILD)/test.stamp
	@$(VENV)/bin/python docs/architecture.py

moving-picture: $(SETUP)
	@$(ENTER) folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT \
	  && eschorty simulate --scene face --start 0 --stop 200 --speed 35 --out "$$folder/rec" \
	  && eschorty reconstruct "$$folder/rec" \
	  && eschorty view "$$folder/rec/cloud.pcd" --out docs/face.gif

check: lint types contracts

lint: $(SETUP) $(BUILD)/test.stamp
	@$(ENTER) ruff check . && ruff format --check .

format: $(BUILD)/test.stamp
	@$(VENV)/bin/ruff check --fix . && $(VENV)/bin/ruff format .

types: $(SETUP) $(BUILD)/test.stamp
	@$(ENTER) mypy

contracts: $(SETUP) $(BUILD)/test.stamp
	@$(ENTER) lint-imports

clean:
	rm -rf $(VENV) $(BUILD)

$(BUILD)/run.stamp: requirements/run.txt requirements/ros.txt requirements/constraints.txt
	@echo "Installing Python packages into .venv"
	@[ -x $(VENV)/bin/python ] || $(PYTHON) -m venv $(VENV_FLAGS) $(VENV)
	@$(PIP) $(RUN_REQUIREMENTS)
	@mkdir -p $(BUILD) && touch $@

$(BUILD)/test.stamp: $(BUILD)/run.stamp requirements/test.txt
	@echo "Installing test packages into .venv"
	@$(PIP) -r requirements/test.txt
	@touch $@

$(BUILD)/interfaces.stamp: $(BUILD)/run.stamp $(INTERFACES)
	@for package in $(EXTERNAL); do $(MAKE) --no-print-directory build-package SOURCE=external_msgs/$$package NAME=$$package; done
	@$(MAKE) --no-print-directory build-package SOURCE=. NAME=eschorty_ros
	@touch $@

.PHONY: build-package
build-package:
	@echo "Building $(NAME)"
	@export PATH="$(VENV)/bin:$$PATH" AMENT_PREFIX_PATH="$(PREFIX):$(UNDERLAY)" \
	  CMAKE_PREFIX_PATH="$(PREFIX):$(UNDERLAY)" LOG="$(BUILD)/$(NAME).log"; \
	{ cmake -S $(SOURCE) -B $(BUILD)/$(NAME) -DCMAKE_INSTALL_PREFIX=$(PREFIX) \
	    -DPython3_EXECUTABLE=$(VENV)/bin/python -DBUILD_TESTING=OFF -DCOMPILE_KERNELS=OFF \
	  && cmake --build $(BUILD)/$(NAME) --parallel $(JOBS) \
	  && cmake --install $(BUILD)/$(NAME); } > $$LOG 2>&1 \
	|| { tail -n 40 $$LOG; echo "Building $(NAME) failed; the whole log is in $$LOG"; exit 1; }

# numba compiles again what has changed since, when it is used. No ROS: it goes beside the interfaces.
$(BUILD)/kernels.stamp: $(BUILD)/run.stamp
	@echo "Compiling kernels, for some minutes"
	@NUMBA_CACHE_DIR="$(BUILD)/numba" $(VENV)/bin/python -c 'from eschorty_ros.cli import main; main(["compile"])'
	@touch $@

# The checkout's Python sources come first, the installed interfaces after them.
$(SETUP): $(BUILD)/interfaces.stamp
	@site=$$(find $(PREFIX) -type d \( -name site-packages -o -name dist-packages \) -print -quit); \
	{ echo '# Generated by make. Source it for a shell with eschorty, its nodes and ROS 2.'; \
	  echo 'export PATH="$(VENV)/bin:$(PREFIX)/bin:$$PATH"'; \
	  echo 'export AMENT_PREFIX_PATH="$(PREFIX):$(UNDERLAY)"'; \
	  echo 'export LD_LIBRARY_PATH="$(PREFIX)/lib$${LD_LIBRARY_PATH:+:$$LD_LIBRARY_PATH}"'; \
	  echo "export PYTHONPATH=\"$(ROOT):$(ROOT)/experiments:$$site\$${PYTHONPATH:+:\$$PYTHONPATH}\""; \
	  echo 'export NUMBA_CACHE_DIR="$(BUILD)/numba"'; } > $@
