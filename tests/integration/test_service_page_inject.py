"""A point of one's own, on the page: a field for each searched hyperparameter, filled with the best trial's values."""

from collections.abc import Iterator
from typing import Any

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select
from synthetic_sweep import make_sweep

pytestmark = IN_A_BROWSER
SPACE = {"lr": {"loguniform": [1e-5, 1e-1]}, "hidden_sizes": {"grid": [[32], [64]]}, "num_epochs": {"randint": [2, 9]}}
CONDITIONAL = {
    "replay": {"choice": ["uniform", "prioritized"]},
    "prioritized_alpha": {"uniform": [0.01, 1.0], "when": {"replay": "prioritized"}},
    "hidden_sizes": {"layers": {"number": [1, 3], "sizes": {"choice": [16, 32, 64]}}},
}
SOME_LACK_ONE: list[dict[str, Any]] = [
    {"replay": "uniform", "hidden_sizes": [32, 16]},
    {"replay": "prioritized", "prioritized_alpha": 0.5, "hidden_sizes": [16]},
]
POINTS = [
    {"lr": 1e-5, "hidden_sizes": [32], "num_epochs": 3},
    {"lr": 3.25e-3, "hidden_sizes": [64], "num_epochs": 5},
]


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    made = make_sweep(name="mine", points=POINTS, with_best=False, max_steps=20_000)
    write_sweep(storage, made, spec={"space": SPACE, "seeds_per_point": 1})
    made = make_sweep(name="conditional", points=SOME_LACK_ONE, with_best=False, max_steps=20_000)
    write_sweep(storage, made, spec={"space": CONDITIONAL, "seeds_per_point": 1, "algorithm": "dqn"})
    plain = make_sweep(name="plain", points=[{}], with_best=False, max_steps=5_000)
    write_sweep(storage, plain, spec={"space": {}})
    with serving(storage) as found:
        yield found


def open_dialog(page: Page, **how: object) -> None:
    page.open("#/sweeps/mine", **how)  # type: ignore[arg-type]
    page.says(".trials-card", "2 trials")
    page.button("More").click()
    page.button("Add a point…").click()


def test_a_point_is_filled_in_changed_and_added(page: Page, live: Live) -> None:
    open_dialog(page)
    values = page.run("return [...document.querySelectorAll('dialog input, dialog select')].map((node) => node.value)")
    assert values == ["0.00325", "64", "5"]
    # As it stands there it is the best trial's.
    page.button("Add and train", "dialog").click()
    page.says("dialog [role=alert]", "has this point already: trial t0001")
    lr = page.one("dialog #field-point-lr")
    lr.clear()
    lr.send_keys("0.5")
    Select(page.one("dialog #field-point-hidden_sizes")).select_by_visible_text("32")
    page.button("Add and train", "dialog").click()
    page.wait("return document.querySelector('.dialog') === null")
    page.says("#toasts", "the point is trained when its turn has come")
    (job,) = live.service.queue.jobs(sweep="mine")
    assert (job.verb, job.arguments) == ("inject", {"point": {"lr": 0.5, "hidden_sizes": [32], "num_epochs": 5}})
    page.says(".sweep-title", "waiting")


def test_numbers_are_asked_for_as_the_space_has_them(page: Page) -> None:
    open_dialog(page)
    assert page.focused() == "lr"
    page.says("dialog", "Searched from 1e-5 to 0.1, on a log scale. Other values may be tried.")
    page.says("dialog", "Searched from 2 to 8.")
    epochs = page.one("dialog #field-point-num_epochs")
    epochs.clear()
    epochs.send_keys("2.5")
    page.button("Add and train", "dialog").click()
    assert page.run("return document.querySelector('dialog form').checkValidity()") is False
    page.keys(Keys.ESCAPE)
    page.wait("return document.querySelector('.dialog') === null")


def test_where_nothing_is_searched_it_is_not_offered(page: Page) -> None:
    page.open("#/sweeps/plain")
    page.says(".trials-card", "1 trial")
    page.button("More").click()
    page.says(".menu", "Replicate leaders…")
    assert "Add a point" not in page.text(".menu")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280])
def test_the_dialog_is_accessible_and_fits(page: Page, width: int, theme: str) -> None:
    open_dialog(page, width=width, theme=theme)
    assert page.violations() == []
    box = page.run("return document.querySelector('dialog').getBoundingClientRect().toJSON()")
    assert box["left"] >= 0
    assert box["right"] <= width


def test_what_does_not_act_is_neither_asked_for_nor_sent(page: Page, live: Live) -> None:
    page.open("#/sweeps/conditional")
    page.says(".trials-card", "2 trials")
    # Nothing stands in the cell of what does not act.
    texts = page.run(
        "return [...document.querySelectorAll('.trials-card tbody tr')]"
        ".map((row) => [...row.cells].map((cell) => cell.innerText.trim()))"
    )
    empty = {each: {row.count("") for row in texts if each in row} for each in ("prioritized", "uniform")}
    assert len(empty["prioritized"]) == 1
    assert empty["uniform"] == {number + 1 for number in empty["prioritized"]}
    page.button("More").click()
    page.button("Add a point…").click()
    is_idle = "return document.querySelector('#field-point-prioritized_alpha').closest('.field').hidden"
    assert page.run(is_idle)
    Select(page.one("dialog #field-point-replay")).select_by_visible_text("prioritized")
    assert page.one("dialog #field-point-prioritized_alpha").get_attribute("value") == "0.505"
    Select(page.one("dialog #field-point-replay")).select_by_visible_text("uniform")
    assert page.run(is_idle)
    sizes = page.one("dialog #field-point-hidden_sizes")
    assert sizes.get_attribute("value") == "32, 16"
    sizes.clear()
    sizes.send_keys("64, 32, 16")
    page.button("Add and train", "dialog").click()
    page.wait("return document.querySelector('.dialog') === null")
    (job,) = live.service.queue.jobs(sweep="conditional")
    assert job.arguments == {"point": {"replay": "uniform", "hidden_sizes": [64, 32, 16]}}
