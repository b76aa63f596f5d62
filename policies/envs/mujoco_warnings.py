"""Let MuJoCo say each of its warnings once in a process.

It says them at each model that is loaded, which is each environment that is made: MuJoCo 4 has one about three of
Gymnasium's robots, which filled the terminal of a sweep. It also writes each into a file of the current folder.
"""

from __future__ import annotations

import sys
from typing import Any


def say_each_once() -> None:
    """Take over MuJoCo's warnings, if it is loaded here and nobody else has."""
    mujoco: Any = sys.modules.get("mujoco")
    if mujoco is None or not hasattr(mujoco, "get_mju_user_warning") or mujoco.get_mju_user_warning() is not None:
        return
    said: set[str] = set()

    def warn(message: str | bytes) -> None:
        text = message if isinstance(message, str) else message.decode(errors="replace")
        if text not in said:
            said.add(text)
            print(f"MuJoCo warns: {text}", file=sys.stderr)

    mujoco.set_mju_user_warning(warn)
