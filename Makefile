# SPDX-License-Identifier: GPL-3.0-or-later
# Every target brings along what it needs: a Python 3.13 (tools/find_python) and the wheel `bpy`, which is Blender.
.PHONY: help demo test lint extension interface pictures clean

help:
	@echo "make demo       bake, relight and draw a small scene; ends with two pictures and a report in build/demo"
	@echo "make test       the linter and every test that needs no installed Blender"
	@echo "make extension  one installable zip per platform in build/extension"
	@echo "make interface  install the zip into a real Blender (BLENDER=/path/to/blender) and test it there"
	@echo "make pictures   take the documentation's pictures in a real Blender (BLENDER=/path/to/blender)"
	@echo "make lint       the linter alone"
	@echo "make clean      remove build/ and .venv"

demo:
	@python=$$(tools/environment.sh runtime) && "$$python" tools/demo.py

test: lint
	@python=$$(tools/environment.sh test) && "$$python" -m pytest -c tests/pytest.ini tests/core tests/rules tests/blender $(ARGS)

lint:
	@python=$$(tools/environment.sh test) && "$$python" -m ruff check .

extension:
	@python=$$(tools/environment.sh runtime) && "$$python" tools/fetch_wheels.py && "$$python" tools/build_extension.py

interface: extension  # BLENDER defaults to the one on the PATH
	@python=$$(tools/environment.sh runtime) && "$$python" tests/interface/run.py --zip build/extension/prt-*-linux-x64.zip \
		--output build/interface --ui "$${BLENDER:-blender}" --headless "$${BLENDER:-blender} --background"

pictures: extension
	@python=$$(tools/environment.sh runtime) && "$$python" tools/pictures.py --zip build/extension/prt-*-linux-x64.zip \
		--ui "$${BLENDER:-blender}" --headless "$${BLENDER:-blender} --background"

clean:
	rm -rf build .venv
