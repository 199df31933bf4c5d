PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: run reproduce test test-long test-vcan coverage mutation check bench figures c faults elf cost misra clean

run: $(READY)  ## the main job: the 10 s sine under the robust ADRC, three processes in lock-step
	$(BIN)/hil run sine

reproduce: $(READY)  ## the paper's evaluation over the bus: out/reproduce/report.html
	$(BIN)/hil reproduce

test: $(READY)  ## all tests that need nothing but this machine
	$(BIN)/python -m pytest

test-long: $(READY)  ## the tests that take minutes
	$(BIN)/python -m pytest -m long

coverage: $(READY)  ## every line and branch of kernel, E2E and state machines is tested
	$(BIN)/python tests/assurance/coverage_run.py

mutation: $(READY)  ## small faults in the same modules are noticed; ARGS=--write puts the scores into docs/testing.md
	$(BIN)/python tests/assurance/mutation.py $(ARGS)

test-vcan: $(READY)  ## the loop on a real vcan0, in a User-Mode Linux guest
	$(BIN)/python -m pytest tests/vcan -m boots_guest
	$(BIN)/python tests/vcan/guest.py --timeout-s 1200 -- $(BIN)/python -m pytest tests/vcan

check: $(READY)  ## style, types, import rules, kernel subset
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m firmware_py.kernel_check

bench: $(READY)  ## speed figures, measured side by side
	$(BIN)/python tests/tools/bench.py

figures: $(READY)  ## rewrite the figures in README from a new evaluation
	$(BIN)/python tests/tools/readme_figures.py --write

c: $(READY)  ## rewrite the exported C in firmware_py/c
	$(BIN)/python -m firmware_py.c_export firmware_py/c

elf: $(READY)  ## rebuild the images of the processors from firmware_py/c and firmware_py/target
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[arm]'
	$(BIN)/python -m firmware_py.emulated.build

cost: $(READY)  ## measure what the images cost; rewrite the figures in README and docs/silicon.md
	command -v arm-none-eabi-gcc >/dev/null || apt-get install --yes --quiet gcc-arm-none-eabi
	command -v riscv64-unknown-elf-gcc >/dev/null || apt-get install --yes --quiet gcc-riscv64-unknown-elf
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[arm]'
	$(BIN)/hil cost --write
	$(BIN)/python tests/tools/cost_figures.py

faults: $(READY)  ## play the fault matrix; rewrite it in docs/fault_matrix.md
	$(BIN)/python tests/tools/fault_figures.py

misra: $(READY)  ## the exported C against MISRA C:2012, deviations listed
	command -v cppcheck >/dev/null || apt-get install --yes --quiet cppcheck
	$(BIN)/python tests/tools/misra.py

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf .venv out build dist *.egg-info
