# SPDX-License-Identifier: Apache-2.0
"""The page beside weights to give away: what they are, and how to use them from where they will lie."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from raytran.checkpoints.hub import FILE_ON_HUB
from raytran.data.files import write_text
from raytran.errors import ConfigError

CARD = "README.md"
"""What hubs show of a repository."""

_HEAD = """\
---
library_name: raytran
tags:
- raytran
- 3d-object-detection
- 3d-reconstruction
---

# {title}

Objects of a room, with class, 9-DoF pose and mesh, from a posed RGB video: weights of a
[RayTran](https://arxiv.org/abs/2203.13296) network for the program raytran.

```bash
raytran predict checkpoint=hf:OWNER/NAME{file} scene=FOLDER output=prediction
```

```python
import raytran

model = raytran.load("hf:OWNER/NAME{file}")
```

| | |
|---|---|
"""


def card_beside(weights: Path) -> Path:
    """Return where the card of a file of weights belongs.

    Raises:
        ConfigError: something lies there, which is not to be lost.
    """
    path = weights.with_name(CARD)
    if path.exists():
        raise ConfigError(
            f"card=true would replace {path}: move it away, or write the weights into a new folder"
        )
    return path


def write_card(path: Path, weights: Path, facts: Mapping[str, Any]) -> None:
    """Write the card of a file of weights.

    Args:
        path: of the card.
        weights: the file.
        facts: what is known of it, by name; None where something is not known.
    """
    file = "" if weights.name == FILE_ON_HUB else f"/{weights.name}"
    rows = [
        f"| {_cell(name)} | {_cell(f'{value:.4g}' if isinstance(value, float) else str(value))} |"
        for name, value in facts.items()
        if value is not None
    ]
    write_text(path, _HEAD.format(title=weights.stem, file=file) + "\n".join(rows) + "\n")


def _cell(text: str) -> str:
    """Return a text that stays within its cell, and is no markup."""
    return " ".join(text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").split())
