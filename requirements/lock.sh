#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Writes uv.lock: the versions of ci.txt and of all that the extras and other systems need beside them, with the hash of every file,
# from PyPI alone. `--check` writes nothing and fails where pyproject.toml asks for other than what is locked.
set -euo pipefail
cd "$(dirname "$0")/.."

arguments=(--no-config --default-index https://pypi.org/simple)
if [ "${1:-}" = --check ]; then
  arguments+=(--check)
else
  while read -r pin; do
    [[ $pin == \#* ]] || arguments+=(--upgrade-package "$pin")
  done < requirements/ci.txt
fi
uv lock "${arguments[@]}"
