"""The file names of the parts of a sweep.

No code outside this package builds paths of a sweep. Messages that name a file take its name from here.
"""

from __future__ import annotations

SWEEP_RECORD = "sweep.json"
TRIAL_RECORD = "trial.json"
RESULTS = "results.jsonl"
DAMAGED_RESULTS = "results.damaged"
DAMAGED_FOLDER = "damaged"
TRIAL_LOG = "log.txt"
DRIVER_LOG = "driver.log"
TALLY = ".tally"
OWNER = ".owner"

TRIALS_FOLDER = "trials"
PACKS_FOLDER = "packs"
CHECKPOINTS_FOLDER = "checkpoints"
COPIES_FOLDER = "copied"
EVENTS_FOLDER = "tensorboard"
MANIFEST = "manifest.json"

BEST_FOLDER = "best"
BEST_RECORD = "evaluation.json"
BEST_POLICY = "policy.json"
FILMS = {
    "before_mp4": "before.mp4",
    "after_mp4": "after.mp4",
    "after_gif": "after.gif",
    "before_after_mp4": "before_after.mp4",
}
"""The films of the winner and of a random policy, in the folder of the best."""
FILMS_RECORD = "films.json"
"""Whose films these are, beside them."""
REPORT_FOLDER = "report"
FIGURES_FOLDER = "figures"
REPORT_PAGE = "index.html"
"""The report's page, in the report's folder; it is written after the other files there."""

LOCK = ".lock"
DRIVER_LOCK = ".driver-lock"
STOP_REQUEST = ".stop"
PROBE_FOLDER = ".probe"
RAY_TUNE_FOLDER = "tune"
