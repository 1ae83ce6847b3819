# `make demo` and `make test` do all set-up themselves on a fresh Debian
# machine. Set-up happens once and again when setup.cfg changes.
#
#   make demo    record the shipped pi2, and a plan of it across a gap and
#                onto a block: out/modes.mp4, out/demo.mp4, out/plan.png
#   make test    lint, format, types and every test
#   make train   train the quickstart policy into runs/quickstart
#   make reproduce  every table and figure of the paper from the shipped
#                policies, into out/reproduction; goes on where it stopped
#   make retrain train all these policies again, into runs/ (hours; see
#                docs/REPRODUCTION.md); goes on where it stopped
#   make lint    lint, format and types alone
#   make docs    these pages and the API as a site: out/site/index.html
#   make pictures  every picture and film of README.md and docs, anew
#   make release  wheel and sdist in out/release, each tried in a fresh
#                environment; uploads nothing
#   make clean   remove what make made, the environment included (not runs/)
#
# Variables: PYTHON (3.11 or later), TORCH (what pip installs as torch: a
# version, a wheel, or `torch --index-url=URL` for an index of CPU wheels),
# PYTEST_ARGS, TRAIN_ARGS.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.PHONY: demo test train reproduce retrain lint tests docs pictures release \
  setup clean

PYTHON ?= python3
PYTEST_ARGS ?=
TRAIN_ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
OUT := out
# Walk, leap, onto the block that launch calls for, leap on top, stand.
SCHEDULE := walk_forward:2.4,leap_forward:2.4,launch:2,leap_forward:2.4,idle:2

# What `make retrain` trains, one after the other.
EXPERIMENTS ?= pi2 pi2_parkour pi1 pi2_paper pi2_uniform pi1_paper pi1_uniform pi3 \
  pi3_paper pi_all pi2_one_hot unimodal_idle unimodal_walk unimodal_leap unimodal_launch

# The pinned build is the CPU one where the index offers it.
TORCH ?= $(if $(shell nvidia-smi -L 2>/dev/null),torch,torch==2.13.0)

# $(call apt,PACKAGES): installs them where we may, else fails.
apt = sudo=; [ "$$(id -u)" = 0 ] || sudo="sudo -n"; \
  $$sudo true 2>/dev/null && command -v apt-get >/dev/null && \
  { $$sudo apt-get update -qq || true; } && \
  $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq \
    --no-install-recommends -o DPkg::Lock::Timeout=120 $(1) </dev/null

demo: setup
	mkdir -p $(OUT)
	$(BIN)/python -m dmc_multimode.bin.record --policy=pi2 \
	  --schedule=$(SCHEDULE) --arena=flat --out=$(OUT)/modes.mp4
	$(BIN)/python -m dmc_multimode.bin.plan --policy=pi2 \
	  --flagfile=flags/plan_gap_block.flags --out=$(OUT)/plan.json \
	  --figure=$(OUT)/plan.png
	$(BIN)/python -m dmc_multimode.bin.record --policy=pi2 \
	  --plan=$(OUT)/plan.json --out=$(OUT)/demo.mp4
	@echo "The videos are modes.mp4 and demo.mp4, the plan is plan.json and" \
	  "plan.png, all in $(CURDIR)/$(OUT)"

# Side by side: types take one core for a minute, and say a line at the end.
test: setup
	$(MAKE) --no-print-directory -j2 lint tests

# A file stays in one process: fixtures of a module are made once.
tests: setup
	$(BIN)/python -m pytest -n auto --dist loadfile $(PYTEST_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Warnings are errors. Docstrings are read, not imported: no extra is needed. The
# variable silences the theme's notice about its future; see CONTRIBUTING.md.
docs: $(VENV)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "The site is $(CURDIR)/$(OUT)/site/index.html"

pictures: setup
	$(BIN)/python -m benchmarks.release.pictures

release: $(VENV)/release
	$(BIN)/python -m benchmarks.release.release --out=$(OUT)/release

train: setup
	$(BIN)/python -m dmc_multimode.bin.train \
	  --flagfile=flags/quickstart.flags --run_dir=runs/quickstart $(TRAIN_ARGS)

reproduce: setup
	$(BIN)/python -m benchmarks.paper.reproduce --out=$(OUT)/reproduction

# Some are long: each is resumed where it stopped, and done ones end at once.
retrain: setup
	for name in $(EXPERIMENTS); do \
	  if [ -e runs/$$name/config.json ]; then what=--resume; else \
	  what="--flagfile=flags/$$name.flags"; fi; \
	  $(BIN)/python -m dmc_multimode.bin.train $$what \
	    --keep_every=3000000 --run_dir=runs/$$name $(TRAIN_ARGS); \
	done

setup: $(VENV)/installed $(VENV)/gl

# Python of the environment: without ensurepip, venv leaves a broken one.
$(BIN)/python:
	@command -v $(PYTHON) >/dev/null && $(PYTHON) -c 'import ensurepip, venv' \
	  2>/dev/null || { $(call apt,python3 python3-venv); } || { \
	  echo "Python's venv is missing: apt-get install python3 python3-venv" >&2; \
	  exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "Python 3.11 or later is needed: make PYTHON=python3.11" >&2; \
	  exit 1; }
	$(PYTHON) -m venv $(VENV)

# torch first and apart: a bare `torch` brings gigabytes of CUDA. Most modules
# are never imported, so that to compile them all would take longer.
pip = $(BIN)/python -m pip install --quiet --no-compile
$(VENV)/installed: setup.cfg pyproject.toml | $(BIN)/python
	$(pip) $(TORCH)
	$(pip) -e '.[dev,export,gym]'
	@touch $@

$(VENV)/docs $(VENV)/release: setup.cfg | $(VENV)/installed
	$(pip) -e '.[$(notdir $@)]'
	@touch $@

# Draws one frame. A machine that cannot still runs what draws nothing.
gl = $(BIN)/python -m dmc_multimode.viewer.gl >$@
$(VENV)/gl: | $(VENV)/installed
	@$(gl) 2>/dev/null || \
	  { { $(call apt,libegl1 libgl1-mesa-dri); }; $(gl) 2>/dev/null; } || \
	  { { $(call apt,libosmesa6); }; $(gl); } || \
	  { rm -f $@; echo 'Going on without drawing.' >&2; }

clean:
	rm -rf $(VENV) out build dist *.egg-info .mypy_cache .pytest_cache \
	  .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
