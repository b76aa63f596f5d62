"""Which failures of a pack's members count against their retries, beside what the pack itself knows of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_pack_driver import Driven

from tune_jobs.store.pack_files import PackFiles
from tune_jobs.training.pack_loop import MemberReport

pytestmark = pytest.mark.ray


def test_a_failure_that_another_member_may_have_caused_is_not_counted(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 4, max_retries=1)
    driven.tell(
        t0000=MemberReport("t0000", error="its process ended", retried=True, counts=False),
        t0001=MemberReport("t0001", error="it broke", retried=True),
    )
    # What the next process of the pack goes by.
    assert PackFiles(driven.store.folder, "p00").read().num_failures == {"t0001": 1}
    assert [driven.status(number) for number in (0, 1)] == [("running", 1), ("running", 1)]
