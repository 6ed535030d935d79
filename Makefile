# jointfitd: the commands for users and contributors. They need python3 (3.11 or newer), python3-venv and make.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

# Thousands of processes import the project: without bytecode each of them compiles it anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install compiled demo test test-compiled test-experiments test-cameras test-cpu test-root test-arm faults endurance load fuzz test-vm lint types imports bench bench-full docs pictures wheel deb sbom release vendor audit lock mutation clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit("python3 is %d.%d: 3.11 or newer is needed" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { echo "python3-venv is missing: sudo apt install python3-venv"; exit 1; }
	@echo "setting up $(VENV) (once, about a minute) ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint requirements.lock --editable '.[all]' --group dev
	@# pip compiles on one core; some libraries carry files for other versions of Python, which do not compile
	@$(BIN)/python -m compileall -q -j 0 $(VENV)/lib >/dev/null 2>&1 || true
	@touch $@

install: $(STAMP)  ## the programs in .venv; then: . .venv/bin/activate

demo: $(STAMP)  ## calibration and live joint angles on simulated sensors and cameras, with an embedded broker
	@$(BIN)/jointfit demo $(ARGS)

test: $(STAMP)  ## all tests that this machine can run, on all cores; skipped tests are listed with their reason
	@$(BIN)/python .ci/suite.py $(ARGS)

test-experiments: $(STAMP)  ## the short experiments of bench against their thresholds
	@$(BIN)/python .ci/suite.py --experiments $(ARGS)

test-cameras: $(STAMP)  ## a rig of four IMU families with each family of cameras, in real time, eight minutes
	@JOINTFIT_ALL_CAMERAS=1 $(BIN)/python -m pytest -q --part experiments tests/system/test_camera_families.py

compiled: $(STAMP)  ## compile the modules that compute the output frames, into build/compiled (needs a C compiler)
	@$(BIN)/python packaging/compiled.py $(ARGS)

test-compiled: compiled  ## the tests of the core, on the compiled modules
	@JOINTFIT_TEST_VARIANT=compiled PYTHONPATH=$(CURDIR)/build/compiled $(BIN)/python -m pytest -q \
	  -o pythonpath="build/compiled ." --junitxml=build/compiled-tests.xml \
	  tests/pipeline/test_core.py tests/pipeline/test_label_monitor.py tests/fusion/test_cluster_pose.py tests/timing/alignment tests/timing/clock tests/drivers/xbus tests/drivers/xcdi tests/packaging/test_variants.py \
	  -m "not experiment and not system and not alone"

test-cpu: $(STAMP)  ## the numerical tests with the arithmetic of other processors (ARGS=--all: all combinations)
	@$(BIN)/python .ci/cpu_features.py $(ARGS)

test-root:  ## the tests and the demo on a fresh minimal Debian, as a user without root (mmdebstrap; root or sudo); ARGS="--suite trixie"
	@$(PYTHON) .ci/minimal_root.py $(ARGS)

test-arm: $(STAMP)  ## the arm64 package in emulation: version, doctor, replay, tests without time limits; hours (mmdebstrap, qemu-user-static, root)
	@$(BIN)/python .ci/arm_root.py $(ARGS)

test-vm: $(STAMP)  ## virtual machines: SocketCAN on a real vcan; power cuts; the .deb under real systemd, with broker and faults
	@$(BIN)/python .ci/light_vm.py
	@$(BIN)/python .ci/power_cut.py
	@$(BIN)/python .ci/full_vm.py $(ARGS)

faults: $(STAMP)  ## every fault of docs/reliability.md on the real daemon (ARGS="--repeat 20" writes the page)
	@$(BIN)/python -m tests.faults $(ARGS)

endurance: $(STAMP)  ## the daemon for 50 million samples, faster than real time; fails if memory or errors grow (ARGS="--samples 1000000")
	@$(BIN)/python -m tests.endurance $(ARGS)

load: $(STAMP)  ## every input of the daemon at its full rate for 30 minutes; fails if a sample is lost (ARGS="--minutes 1")
	@$(BIN)/python -m tests.load $(ARGS)

$(VENV)/.fuzz: $(STAMP)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --group fuzz
	@touch $@

fuzz: $(VENV)/.fuzz  ## coverage-guided fuzzing of every input, 10^7 cases (an hour); ARGS="xbus-bytes --seconds 60"
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.fuzz $(ARGS)

$(VENV)/.mutation: $(STAMP)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --group mutation
	@touch $@

mutation: $(VENV)/.mutation  ## share of 200 random code changes (mutants) that the tests detect, in protocols, timing, fusion and calibration record (ARGS="--mutants 20 --jobs 2")
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.mutation $(ARGS)

lint: $(STAMP)  ## ruff: rules and format
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

types: $(STAMP)  ## mypy, strict
	@$(BIN)/mypy

imports: $(STAMP)  ## rules for imports between packages
	@$(BIN)/lint-imports

bench: $(STAMP)  ## the main experiments and a short one of every kind, 10 minutes; fails if a result misses its threshold
	@$(BIN)/python -m bench $(ARGS)

bench-full: $(STAMP)  ## all experiments, about an hour; writes bench/results and the pages of docs
	@$(BIN)/python -m bench --full $(ARGS)

pictures: $(STAMP)  ## make the generated pictures of the documentation again, docs/pictures
	@$(BIN)/python -m tests.pictures

docs: $(STAMP)  ## the documentation as a site, warnings are errors
	@$(BIN)/python -m bench.framework.pages
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir build/site

wheel: $(STAMP)  ## wheels (pure; compiled with a C compiler) and sdist in build/packages: checked, installed in empty environments
	@$(BIN)/python .ci/check_wheel.py build/packages

deb: $(STAMP)  ## the Debian package in build/packages, with compiled modules if a C compiler is installed; pure Python for a Raspberry Pi: ARGS="--arch arm64"
	@$(BIN)/python packaging/deb.py $(ARGS)

sbom: $(STAMP)  ## bill of materials of the Debian package, as CycloneDX JSON in build/packages
	@$(BIN)/python packaging/sbom.py $(ARGS)

release: $(STAMP)  ## wheels, sdist, Debian packages and bill of materials with signed checksums: ARGS="--key KEY.pem"
	@$(BIN)/python packaging/release.py $(ARGS)

vendor: $(STAMP)  ## fetch the dashboard's vendored scripts again by npm, and compare their SHA-256
	@$(BIN)/python packaging/vendor.py

audit: $(STAMP)  ## ask the Python vulnerability service about requirements.lock
	@$(BIN)/python .ci/audit.py

lock: $(STAMP)  ## write the versions that are installed now to requirements.lock
	@$(BIN)/python .ci/lock.py > requirements.lock.new && mv requirements.lock.new requirements.lock || { rm -f requirements.lock.new; exit 1; }

clean:  ## delete the files that make created
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .benchmarks
