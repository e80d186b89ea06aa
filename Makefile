# Two commands do all: `make demo` and `make test`.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
# The first interpreter of a supported version, unless one is named: make test PYTHON=python3.12
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$p && break; done)
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Where this is set, every worker and every command of the tests would compile all of the sources anew.
unexport PYTHONDONTWRITEBYTECODE
# Wheels alone, in every `pip install` below: a source distribution would fetch build tools that nothing pins, and run them.
export PIP_ONLY_BINARY := :all:
# But vqf, and ezc3d of the tests, have wheels for x86-64 alone. Elsewhere their hashed sources are built, by tools that
# are hashed wheels themselves.
ifneq ($(shell uname -m),x86_64)
BUILD_TOOLS := requirements/source.lock
BUILD_TOOLS_DEV := requirements/source_dev.lock
FROM_SOURCE := --no-binary vqf,ezc3d --no-build-isolation
endif

.PHONY: help demo test test-all test-slow test-alone attack test-socketcan firmware test-firmware test-blender release-check firmware-tools firmware-sizes firmware-figures lint golden-renew docs bench soak soak-faults fuzz audit install install-dev system-tools lock clean

help:
	@echo "make demo    emulated suit -> gateway -> embedded broker -> live page, orientations and their error"
	@echo "make test    install what the tests need (mosquitto and chromium too, where apt may) and run them"
	@echo "make test-all  these, then those that are marked slow, each with its reason in its mark (make test-slow: these alone;"
	@echo "               make test-alone: the one that wants a machine for itself)"
	@echo "make attack  the attacks that docs/reference/security.md promises to withstand (make test has them too)"
	@echo "make test-socketcan  SocketCAN on the kernel's virtual buses, in a virtual machine if need be"
	@echo "make firmware  the reference module (firmware_protocol/reference) for each board that can be built here"
	@echo "make test-firmware  it as a process and as machine code in QEMU, against the gateway and the protocol's rules"
	@echo "make firmware-sizes  its bytes of flash and RAM, deepest stack, instructions a sample"
	@echo "make firmware-figures  these, and what its tests see, slow ones too, into docs/guide/firmware.md"
	@echo "make test-blender  the add-on in Blender without a window (Blender is 370 MB; Python 3.11 or 3.13)"
	@echo "make release-check  wheel, source distribution and image; the wheel tried in an environment of its own and in a bare Debian"
	@echo "make lint    ruff, mypy and the spelling of code and documents"
	@echo "make golden-renew  after a change that is meant to change poses: store them anew, say by how much each moved"
	@echo "make bench   measure, and rewrite the figures in docs/"
	@echo "make docs    the pages in docs/ as HTML"
	@echo "make soak    ten million wire frames, damaged and good, through the decoders, readable and compiled;"
	@echo "             then MINUTES=20 of random faults on a running gateway (make soak-faults: these alone)"
	@echo "make fuzz    MINUTES=30 of coverage-guided fuzzing (Linux on x86-64); what it reaches stays in build/fuzz"
	@echo "make audit   known vulnerabilities of the pinned dependencies"
	@echo "make lock    pin the dependencies anew"

$(VENV)/pyvenv.cfg:
	@test -n "$(PYTHON)" || { echo "No Python 3.11, 3.12 or 3.13 found. Install one (Debian: apt install python3 python3-venv) or name it: make $(MAKECMDGOALS) PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 || { rm -rf $(VENV); \
		if $(PYTHON) -m pip --version >/dev/null 2>&1; then \
			$(PYTHON) -m venv --without-pip $(VENV) && $(PYTHON) -m pip --python $(BIN)/python install -q pip; \
		elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
			apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq python3-venv >/dev/null && $(PYTHON) -m venv $(VENV); \
		else echo "$(PYTHON) cannot make a virtual environment. Debian: sudo apt install python3-venv"; exit 1; fi; }

$(VENV)/.runtime: requirements/runtime.lock pyproject.toml $(BUILD_TOOLS) | $(VENV)/pyvenv.cfg
	@echo "Installing what the gateway needs ..."
	@[ -z "$(BUILD_TOOLS)" ] || $(BIN)/python -m pip install -q --require-hashes -r $(BUILD_TOOLS)
	@$(BIN)/python -m pip install -q $(FROM_SOURCE) --require-hashes -r requirements/runtime.lock
	@$(BIN)/python -c 'import pathlib, sysconfig; pathlib.Path(sysconfig.get_path("purelib"), "mocap_gateway_tree.pth").write_text(str(pathlib.Path.cwd()))'
	@printf '#!/bin/sh\nexec "$(CURDIR)/$(BIN)/python" -m gateway "$$@"\n' > $(BIN)/mocap-gateway && chmod +x $(BIN)/mocap-gateway
	@touch $@

$(VENV)/.dev: requirements/dev.lock $(BUILD_TOOLS_DEV) $(VENV)/.runtime
	@echo "Installing what the tests need ..."
	@[ -z "$(BUILD_TOOLS_DEV)" ] || $(BIN)/python -m pip install -q --require-hashes -r $(BUILD_TOOLS_DEV)
	@$(BIN)/python -m pip install -q $(FROM_SOURCE) --require-hashes -r requirements/dev.lock
	@touch $@

# What the usual run needs is compiled once; where that fails the first start does it.
install: $(VENV)/.runtime
	@$(BIN)/python -m gateway kernels build || echo "Kernels could not be compiled beforehand: the first start will."
install-dev: $(VENV)/.dev

# What tests need from the system: a broker, and a browser with what drives it. NAME=PACKAGE+PACKAGE
SYSTEM_TOOLS := mosquitto=mosquitto mosquitto_sub=mosquitto-clients chromium=chromium+libatomic1

system-tools:
	@for tool in $(SYSTEM_TOOLS); do \
		program=$${tool%%=*}; packages=$${tool##*=}; packages=$${packages//+/ }; \
		command -v $$program >/dev/null || [ -x /usr/sbin/$$program ] && continue; \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then sudo=""; \
		elif sudo -n true 2>/dev/null && command -v apt-get >/dev/null; then sudo="sudo"; \
		else echo "$$program is not installed and may not be: the tests that need it will be skipped (apt install $$packages)"; continue; fi; \
		echo "Installing $$program ..."; \
		$$sudo apt-get update -qq && $$sudo env DEBIAN_FRONTEND=noninteractive RUNLEVEL=1 apt-get install -y -qq --no-install-recommends $$packages >/dev/null \
			|| echo "$$program could not be installed: the tests that need it will be skipped"; \
	done

demo: install
	@$(BIN)/python -m gateway demo $(DEMO)

SPELT := README.md CONTRIBUTING.md CHANGELOG.md Makefile docs gateway devices firmware_protocol benchmarks config examples docker

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell $(SPELT)

# Linted beside the tests, for neither waits for the other; many tests wait: two workers a core keep it busy. Browsers
# come after the rest: without a graphics card they take every core from modules whose samples come in real time. What
# failed is named once more at the very end, where who reads a long log looks first.
CORES := $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
WORKERS := $(shell expr 2 \* $(CORES))
PYTEST_ALL = $(BIN)/python -m pytest --dist worksteal --durations 10 $(TESTS)
NONE := 5# what pytest ends with where it was asked for no test
# With CI=true no test passes over a tool that is missing: then those of the firmware are installed, too.
test: install-dev system-tools $(if $(filter true,$(CI)),firmware)
	@mkdir -p build; $(MAKE) -s lint > build/lint.log 2>&1 & lint=$$!; \
	$(PYTEST_ALL) -n $(WORKERS) -m "not slow and not browser" | tee build/tests.log; tests=$${PIPESTATUS[0]}; \
	$(PYTEST_ALL) -n $(CORES) -m "browser and not slow" | tee build/pages.log; pages=$${PIPESTATUS[0]}; \
	[ $$tests != $(NONE) ] || tests=$$pages; [ $$pages != $(NONE) ] || pages=$$tests; \
	wait $$lint; lint=$$?; cat build/lint.log; \
	grep -hE "^(FAILED|ERROR) " build/tests.log build/pages.log | cut -c -200; \
	exit $$((tests ? tests : pages ? pages : lint))

test-all: test test-slow

# Those with a page and a person in real time run one after the other: drawing takes a core of its own.
# One of them judges how a gateway recovers, and wants the machine for itself: `make test-alone`.
ALONE := tests/system/test_overload_service.py
test-slow: install-dev system-tools
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "slow and not browser" --durations 10 --ignore $(ALONE)
	$(BIN)/python -m pytest -m "slow and browser" --durations 10

test-alone: install-dev system-tools
	$(BIN)/python -m pytest -m slow $(ALONE)

golden-renew: install-dev
	@$(BIN)/python -m tests.golden renew $(CASES)

attack: install-dev system-tools
	$(BIN)/python -m pytest tests/attack

test-socketcan: install-dev firmware
	@PYTHON=$(BIN)/python tests/socketcan/run.sh

# What the firmware is built with, and run in; without a C compiler and the right to install one, a wheel has it.
FIRMWARE_TOOLS := make=make cc=gcc+libc6-dev arm-none-eabi-gcc=gcc-arm-none-eabi qemu-system-arm=qemu-system-arm
HOST_CC = $(shell for c in cc gcc clang; do command -v $$c && break; done || echo "$(CURDIR)/$(BIN)/python -m ziglang cc")

firmware-tools: $(VENV)/pyvenv.cfg
	@$(MAKE) -s system-tools SYSTEM_TOOLS="$(FIRMWARE_TOOLS)"
	@command -v cc gcc clang >/dev/null || $(BIN)/python -c 'import ziglang' 2>/dev/null || $(BIN)/python -m pip install -q "ziglang>=0.13,<1"

firmware: firmware-tools
	@$(MAKE) --no-print-directory -C firmware_protocol/reference CC="$(HOST_CC)"

test-firmware: install-dev system-tools firmware-tools
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations 5 tests/firmware

firmware-sizes: firmware
	@$(BIN)/python -m benchmarks.firmware

firmware-figures: install-dev system-tools firmware
	@rm -rf build/firmware_figures && mkdir -p build/firmware_figures
	FIRMWARE_FIGURES=$(CURDIR)/build/firmware_figures $(BIN)/python -m pytest -n 2 --dist worksteal -m "slow or not slow" tests/firmware
	@$(BIN)/python -m benchmarks.firmware --figures build/firmware_figures --write-docs

# What is given away: wheel and source distribution, the wheel in an environment of its own, far from this tree, and in
# a bare Debian. The source distribution has all that the wheel is built from. The image is built without an engine, by
# buildah. What this machine cannot do is left out, with the reason (77).
RELEASE := build/release
release-check: install-dev
	rm -rf $(RELEASE) && mkdir -p $(RELEASE)/from_source
	$(BIN)/hatchling build -d $(RELEASE) -t sdist -t wheel
	tar -xzf $(RELEASE)/*.tar.gz --strip-components 1 -C $(RELEASE)/from_source
	cd $(RELEASE)/from_source && $(CURDIR)/$(BIN)/hatchling build -d .. -t wheel
	$(PYTHON) -m venv $(RELEASE)/venv
	$(RELEASE)/venv/bin/python -m pip install -q $(FROM_SOURCE) --require-hashes -r requirements/runtime.lock
	$(RELEASE)/venv/bin/python -m pip install -q --no-deps $(RELEASE)/*.whl
	cd $(RELEASE) && venv/bin/mocap-gateway --version && venv/bin/mocap-gateway body list && venv/bin/mocap-gateway demo --seconds 10 --no-page
	.ci/bare_debian $(RELEASE)/*.whl requirements/runtime.lock || [ $$? = 77 ]
	$(BIN)/python -m pytest -m slow -rs tests/docker
	@echo "release-check: passed; what was left out stands above"

# In an environment of its own: Blender wants another NumPy, and is for one version of Python alone.
test-blender: install-dev
	@[ -x build/blender/bin/python ] || { $(PYTHON) -m venv build/blender && build/blender/bin/python -m pip install -q "bpy>=5,<6"; }
	$(BIN)/python -m pytest tests/gateway/recording/test_blender_addon.py

docs: install-dev
	$(BIN)/python -m sphinx -q -W -b html docs docs/_build
	@echo "open docs/_build/index.html"

bench: install-dev system-tools
	$(BIN)/python -m benchmarks all --write-docs

soak soak-faults: MINUTES ?= 20
soak: install-dev system-tools
	$(BIN)/python -m devices.emulators.faults.wire_campaign --frames 10000000
	$(BIN)/python -m devices.emulators.faults.makers_campaign --damaged 1000000
	$(BIN)/python -m benchmarks.wire_both_ways --frames 10000000
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES)

soak-faults: install-dev system-tools
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES)

# Not among the pinned ones: it has no wheel for arm64, where fuzzing is left out.
$(VENV)/.fuzz: $(VENV)/.dev
	@$(BIN)/python -m pip install -q "atheris>=3,<4"
	@touch $@

fuzz: MINUTES ?= 30
fuzz: $(VENV)/.fuzz
	$(BIN)/python -m benchmarks.fuzzing.campaign --minutes $(MINUTES) $(TARGETS)

audit: $(VENV)/pyvenv.cfg
	@$(BIN)/python -m pip_audit --version >/dev/null 2>&1 || $(BIN)/python -m pip install -q "pip-audit>=2.9,<3" \
		|| echo "pip-audit is not installed and could not be"
	@$(BIN)/python -m benchmarks.audit requirements/runtime.lock requirements/dev.lock

lock:
	$(PYTHON) -m venv build/lock && build/lock/bin/python -m pip install -q uv
	build/lock/bin/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url pyproject.toml --extra dev --extra viewer --extra export --extra optical --extra video --extra biomech --extra foxglove --extra ros2 --extra robot --extra fleet -o requirements/dev.lock
	build/lock/bin/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url pyproject.toml --extra viewer -c requirements/dev.lock -o requirements/runtime.lock
	echo 'hatchling>=1.27' | build/lock/bin/uv pip compile -q --universal --only-binary :all: --python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url - -c requirements/dev.lock -o requirements/build.lock
	printf 'cython>=3\nnumpy\nsetuptools\nwheel\n' | build/lock/bin/uv pip compile -q --universal --only-binary :all: --python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url - -c requirements/dev.lock -o requirements/source.lock
	printf 'scikit-build\ncmake\nninja\nswig\ncython>=3\nnumpy\nsetuptools\nwheel\n' | build/lock/bin/uv pip compile -q --universal --only-binary :all: --python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url - -c requirements/dev.lock -c requirements/source.lock -o requirements/source_dev.lock

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
