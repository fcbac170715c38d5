# SPDX-License-Identifier: Apache-2.0
"""Where the YAML files of ``conf/`` are: inside an installed wheel, or at the top of a clone."""

from __future__ import annotations

from pathlib import Path

from raytran.errors import ConfigError

_PACKAGE = Path(__file__).resolve().parents[1]


def config_dir(package: Path = _PACKAGE) -> Path:
    """Return the folder of configs, absolute, so that every command works from any directory.

    Args:
        package: the folder of the package ``raytran``.

    Raises:
        ConfigError: neither an installed nor a cloned ``conf/`` is there.
    """
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise ConfigError(
        f"no configs found in {package / 'conf'} or {package.parents[1] / 'conf'}: reinstall raytran, "
        "or run from a complete clone"
    )
