#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Does pip find versions that fit together, from PyPI alone? For the three ways to install (the exact set of ci.txt, `pip install .`,
# `pip install '.[dev]'`), every Python, and the oldest, the newest and some torch between. uv resolves as pip would, for Pythons
# that are not installed too, and reads metadata only, where pip would download torch with CUDA, gigabytes of it, nine times.
set -uo pipefail
cd "$(dirname "$0")/.."

pythons=(3.11 3.12 3.13 3.14)
torches=(2.8.0 2.11.0 2.13.0 newest)  # of pyproject.toml's range; 2.11 is the first after those that it leaves out
failed=0

resolve() {  # NAME PYTHON CONSTRAINT ARGUMENTS…
  local name=$1 python=$2 constraint=$3 found
  shift 3
  # antlr4, of omegaconf, is the one package that is published as source only.
  if found=$(uv pip compile --quiet --no-header --no-annotate --no-config --default-index https://pypi.org/simple \
    --python-version "$python" --python-platform x86_64-manylinux_2_28 \
    --only-binary :all: --no-binary antlr4-python3-runtime --constraints <(echo "$constraint") "$@" 2>&1); then
    echo "ok      Python $python, $name: $(grep -E '^(torch|triton)==' <<<"$found" | paste -sd ' ')"
  else
    echo "FAILED  Python $python, $name"
    echo "$found"
    failed=1
  fi
}

for python in "${pythons[@]}"; do
  resolve "make install" "$python" "" requirements/ci.txt
  for torch in "${torches[@]}"; do
    [ "$python $torch" = "3.14 2.8.0" ] && continue  # Python 3.14 came after it
    constraint=$([ "$torch" = newest ] || echo "torch==$torch")
    resolve "pip install ." "$python" "$constraint" pyproject.toml
    resolve "pip install '.[dev]'" "$python" "$constraint" --extra dev pyproject.toml
  done
done
exit "$failed"
