"""`tune-jobs serve` whose sweeps take a moment and train nothing: all else, processes too, is as it is."""

import functools

from tests.narrowing import present
from tune_jobs.cli.commands import main
from tune_jobs.service import supervisor
from tune_jobs.service.spare import Driver

present(supervisor.Supervisor.__init__.__kwdefaults__)["make_driver"] = functools.partial(Driver, module="fake_driver")

if __name__ == "__main__":
    main()
