"""The service's figures: lists, the page in a browser, how soon a sweep begins, what watchers cost, and a day of it."""

import sys
from pathlib import Path

# The made-up sweeps are those of the tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "unit"))
