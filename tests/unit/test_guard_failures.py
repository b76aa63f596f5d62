"""What is told of an environment that ended the guard's child."""

from pathlib import Path

import pytest

import policies
from policies.guard.failures import frames_in

PACKAGE = Path(policies.__file__).parent
CRASH = f"""\
Fatal Python error: Segmentation fault

Thread 0x00007f3e51 (most recent call first):
  File "/usr/lib/python3/threading.py", line 359 in wait

Current thread 0x00007f3e52 (most recent call first):
  File "/home/me/my_envs.py", line 12 in touch
  File "/home/me/my_envs.py", line 30 in step
  File "/usr/lib/python3/site-packages/gymnasium/core.py", line 327 in step
  File "{PACKAGE}/envs/calls.py", line 140 in told
  File "{PACKAGE}/guard/child.py", line 60 in main
"""
C_STACK = """
Current thread's C stack trace (most recent call first):
  Binary file "/usr/bin/python3.14", at _Py_DumpStack+0x2d [0x5a]
  Binary file "/usr/bin/python3.14" [0x5b]
"""
MODULES = "\nExtension modules: numpy._core._multiarray_umath (total: 1)\n"


@pytest.mark.parametrize(
    "dump",
    [
        CRASH + MODULES,
        CRASH.replace(" (most", " [python] (most") + C_STACK + MODULES,  # Python 3.14's
    ],
)
def test_the_users_frames_are_those_of_the_python_code_that_crashed(dump: str) -> None:
    assert frames_in(dump) == [
        'File "/home/me/my_envs.py", line 12 in touch',
        'File "/home/me/my_envs.py", line 30 in step',
    ]
