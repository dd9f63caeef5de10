# Two commands on a fresh machine: `make demo`, `make test`. Both create .venv, and create it again
# when a lock file, pyproject.toml or the path of this directory has changed.
# Requires GNU make 3.81 or later and any POSIX shell. PYTHON=... chooses the interpreter.

SHELL = /bin/sh
BIN = .venv/bin
PIP = $(BIN)/python -m pip --disable-pip-version-check install --quiet --require-hashes
PYTEST = $(BIN)/python -m pytest
UV = uv

# The matrices are small: BLAS threads slow them down and make timings vary.
OPENBLAS_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS

# If this is set, every process that the tests start compiles all its imports again, which takes as
# long as the tests themselves.
unexport PYTHONDONTWRITEBYTECODE

# Two workers. Tests that start services run on one of them, one after the other.
WORKERS = -n 2 --dist loadgroup

.PHONY: demo test test-all check site bench soak fuzz messages dist format lock clean FORCE

demo: .venv/.runtime
	$(BIN)/companion demo

# The tests that every change must pass, at most five minutes on two quiet cores. Tests marked `full`
# are left out. Warnings are errors (pyproject.toml).
test: .venv/.dev
	$(PYTEST) -q $(WORKERS) -m "not full and not benchmark and not soak"

# All tests, with more examples of each property.
test-all: .venv/.dev
	HYPOTHESIS_PROFILE=full $(PYTEST) -q $(WORKERS)

# Formatter, linter, type checker, architecture rules, container files, and the documents, which are
# built as a site with warnings as errors.
check: .venv/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --strict companion sitl_replay
	$(BIN)/python tests/dead_code.py
	$(BIN)/lint-imports
	$(BIN)/hadolint Dockerfile examples/blueos/Dockerfile
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml
	@if docker compose version >/dev/null 2>&1; then docker compose --profile demo config --quiet; \
	else echo "no docker compose here: docker-compose.yml is held against its schema alone"; fi
	$(BIN)/python docs/make_site.py
	$(PYTEST) -q tests/test_house.py tests/test_docs.py

# The documents as a site for reading offline: build/site/index.html.
site: .venv/.dev
	$(BIN)/python docs/make_site.py

# Tests marked `benchmark` and `soak`, which `make test` leaves out. The figures are written to
# build/bench.json (or BENCH_JSON), and compared with the previous ones there.
bench: .venv/.dev
	$(PYTEST) -q -s -m benchmark

# Some 25 minutes. Floods and attacks run alone, all others two at a time. Each worker takes two tests
# at the start, so that the first one of the second file waits for the longest: it must be short.
SOAK_BESIDE = $(addprefix tests/,live/test_all_together.py mavlink/wire/test_framing_fuzz.py \
    pipeline/test_day.py server/test_contract.py live/test_recording.py)
soak: .venv/.dev
	failed=; \
	$(PYTEST) -q -rP -n 2 --maxschedchunk 1 --durations 12 -m soak --timeout=0 $(SOAK_BESIDE) || failed=1; \
	$(PYTEST) -q -s --durations 12 -m soak --timeout=0 $(addprefix --ignore=,$(SOAK_BESIDE)) || failed=1; \
	test -z "$$failed"

# Failing inputs are in build/fuzz/TARGET/crash-…; inputs that reach new code join the corpus.
FUZZ_SECONDS = 600
fuzz: .venv/.dev
	@for target in framing fold recovery settings http; do \
	    $(BIN)/python tests/fuzzing/run.py $$target $(FUZZ_SECONDS) --keep || exit 1; done

# Collects every error and notice that the tests cause in docs/messages.md.
messages: .venv/.dev
	rm -f build/texts.jsonl && mkdir -p build
	-COLLECT_TEXTS=build/texts.jsonl $(PYTEST) -q $(WORKERS) -m "not full and not benchmark and not soak"
	$(BIN)/python docs/list_texts.py --collected build/texts.jsonl

# What is installed by name: wheel, source archive and, with dpkg-deb, the Debian package of this
# machine's architecture. The date of the newest commit makes builds identical.
dist: .venv/.dev
	rm -rf dist
	export SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct); \
	$(BIN)/python -m hatchling build -d dist && \
	if command -v dpkg-deb >/dev/null; then $(BIN)/python deploy/build_deb.py --out dist; \
	else echo "no dpkg-deb here: no Debian package"; fi

format: .venv/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Keeps recordings.
clean:
	rm -rf .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis \
	    .import_linter_cache .coverage htmlcov *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- the environment ----------------------------------------------------------------------------

# The stamp contains the directory of .venv: a moved or copied .venv is created again.
ifneq ($(shell test -x $(BIN)/python && cat .venv/.runtime 2>/dev/null),$(CURDIR))
.venv/.runtime: FORCE
endif

.venv/.runtime: requirements.lock pyproject.toml
	@$(find_python); \
	echo "creating .venv with $$($$python -V) (once; one to four minutes)"; \
	"$$python" -m venv --clear .venv
	@$(PIP) -r requirements.lock
	@$(PIP:--require-hashes=) --no-deps --no-build-isolation --editable .
	@printf '%s\n' "$(CURDIR)" > $@

.venv/.dev: .venv/.runtime requirements-dev.lock
	@echo "adding the tools for tests to .venv"
	@$(PIP) -r requirements-dev.lock
	@touch $@

# Sets $$python to the first suitable interpreter, or prints in one line what is missing.
define find_python
python=; old=; bare=; \
for p in $(if $(PYTHON),'$(PYTHON)',python3.13 python3.12 python3.11 python3); do \
    v=$$("$$p" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue; \
    if ! "$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then old="$$p is $$v"; \
    elif ! "$$p" -c 'import venv, ensurepip' 2>/dev/null; then bare="$$p"; \
    else python="$$p"; break; fi; \
done; \
if [ -z "$$python" ]; then \
    if [ -n "$$bare" ]; then echo "$$bare has no venv module: install it" \
        "(Debian, Ubuntu: apt install python3-venv)"; \
    elif [ -n "$$old" ]; then echo "Python 3.11 or later is needed, and $$old:" \
        "install a newer one, or name it with PYTHON=..."; \
    else echo "Python 3.11 or later is needed, and" \
        "$(if $(PYTHON),$(PYTHON) is not one,there is no python3): install one, or name it" \
        "with PYTHON=..."; \
    fi >&2; \
    exit 1; \
fi
endef

# Versions and hashes, without registry addresses.
COMPILE = $(UV) pip compile pyproject.toml --universal --python-version 3.11 \
    --fork-strategy fewest --generate-hashes --no-header --no-annotate --quiet $(UPGRADE)

# Keeps versions that still satisfy pyproject.toml; `make lock UPGRADE=--upgrade` takes the newest.
lock:
	@command -v $(UV) >/dev/null || { echo "make lock needs uv; name it with UV=..." >&2; exit 1; }
	$(COMPILE) --group build --output-file requirements.lock
	$(COMPILE) --group build --extra dev --constraint requirements.lock \
	    --output-file requirements-dev.lock
	@! grep -n '://' requirements.lock requirements-dev.lock
