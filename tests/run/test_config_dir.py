# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.errors import ConfigError
from raytran.run.config_dir import config_dir


def test_a_clone_keeps_configs_at_its_top(tmp_path):
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "train.yaml").touch()
    assert config_dir(tmp_path / "src" / "raytran") == tmp_path / "conf"


def test_a_wheel_keeps_configs_inside(tmp_path):
    package = tmp_path / "site-packages" / "raytran"
    (package / "conf").mkdir(parents=True)
    (package / "conf" / "train.yaml").touch()
    assert config_dir(package) == package / "conf"


def test_without_configs_there_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="reinstall raytran"):
        config_dir(tmp_path / "src" / "raytran")


def test_this_project_has_them(project_root):
    assert config_dir() == project_root / "conf"
