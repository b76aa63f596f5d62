"""What follows the trials is imported while they train: an upgrade meanwhile replaces the files, and ends nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from sweep_folders import make_sweep_folder

FINISHES = """if True:
    import sys
    from pathlib import Path
    from policies.guard.guard import guarding
    from tune_jobs.store.sweep_store import SweepStore
    from tune_jobs.sweeps import importing, verbs
    from tune_jobs.sweeps.finishing import finish_sweep
    from tune_jobs.sweeps.live_view import working
    from tune_jobs.sweeps.monitor import SweepMonitor
    from tune_jobs.sweeps.outcome import SweepResult
    import policies.guard.guarded, tune_jobs.cli.output, tune_jobs.ray_tune.run_trials


    def ours():
        return {name for name in sys.modules if name.partition(".")[0] in ("tune_jobs", "policies", "analysis")}


    def main():
        store = SweepStore(Path(sys.argv[1]))
        records = store.read_trials()
        monitor = SweepMonitor("mine", [], caps={})
        importing.importing_what_follows(monitor)(records[0])
        before = ours()
        with guarding():
            result = finish_sweep(store, SweepResult(store.place, store.read_record(), records))
        assert result.exit_code == 0, result
        print(result.artifacts.keys() >= {"policy", "report"}, sorted(ours() - before))


    main()
"""


def test_what_follows_the_trials_imports_nothing_of_ours_any_more(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    done = subprocess.run(
        [sys.executable, "-c", FINISHES, str(store.folder)], capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[-1:] == ["True []"], done.stderr
