"""The service's page in a browser, driven as a reader would: look, sort, filter, brush, submit, stop."""

import httpx2
import pytest
from live_service import Live
from page_browser import IN_A_BROWSER, Page
from page_sweeps import HOSTILE, write_large
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = IN_A_BROWSER
FAILED = "#/sweeps/cartpole-ppo?trial=t0003"
LOST = """
    const ask = window.fetch;
    Object.assign(window, { keys: [], numPlans: 0 });
    window.fetch = (url, options) => {
      const key = options?.headers?.["Idempotency-Key"];
      if (String(url).endsWith("/plans")) window.numPlans += 1;
      if (!key) return ask(url, options);
      window.keys.push(key);
      return Promise.reject(new TypeError("lost"));
    };
    window.type = (text) => {
      const area = document.querySelector("#sweep-file");
      area.value += text;
      area.dispatchEvent(new Event("input", { bubbles: true }));
    };
    window.submit = () => document.querySelector("form.submit").requestSubmit();
"""
"""A page whose submissions are lost on the way; the keys that they had are kept."""


def column(page: Page, heading: str) -> list[str]:
    """The texts of a column of the table of trials, of the rows that are there."""
    script = """
        const head = document.querySelector(".trials thead tr");
        const body = document.querySelector(".trials tbody:has(th)");
        const place = [...head.cells].findIndex((cell) => cell.innerText.trim() === arguments[0]);
        return place < 0 || !body ? [] : [...body.rows].map((row) => row.cells[place].innerText);
    """
    found: list[str] = page.run(script, heading)
    return found


def numbers(page: Page, heading: str) -> list[float]:
    return [float(text.replace(",", "")) for text in column(page, heading) if text[0].isdigit()]


def num_trials(page: Page) -> str:
    return page.text(".trials-card [role=status]")


def test_sweeps_are_listed_sorted_searched_and_filtered(page: Page) -> None:
    page.open()
    page.says("main", "cartpole-seeds")
    names = "return [...document.querySelectorAll('.sweeps tbody th a')].map((link) => link.innerText)"
    assert page.run(names) == ["cartpole-seeds", "cartpole-ppo", "pendulum-no-space"]
    assert "interrupted" in page.text(".sweeps tbody tr")
    page.button("Sweep", "thead").click()
    assert page.run(names) == ["cartpole-ppo", "cartpole-seeds", "pendulum-no-space"]
    page.one("input[type=search]").send_keys("Pendulum")
    assert page.run(names) == ["pendulum-no-space"]
    assert "search=Pendulum" in page.address()
    page.browser.refresh()
    assert page.wait(f"return ({names.removeprefix('return ')}).length === 1")
    page.open("#/?state=running")
    page.says(".empty", "No sweep matches.")


def test_a_link_reproduces_what_is_looked_at(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo")
    page.says(".trials-card", "60 trials")
    scores = numbers(page, "score")
    assert scores == sorted(scores, reverse=True)
    page.button("lr", ".trials").click()
    assert numbers(page, "lr") == sorted(numbers(page, "lr"), reverse=True)
    page.button("lr", ".trials").click()
    assert numbers(page, "lr") == sorted(numbers(page, "lr"))
    page.one(".trials-card input[type=search]").send_keys("relu score>100")
    assert set(column(page, "activation")) == {"relu"}
    page.browser.find_elements(By.CSS_SELECTOR, ".trials tbody input")[1].click()
    chosen = page.wait("return document.querySelector('.trials tr.chosen th')?.innerText")
    page.until(lambda: page.text(".curves .keys").startswith(chosen))
    before = (column(page, "trial"), num_trials(page), page.text(".curves .keys"))
    assert f"chosen={chosen}" in page.address()
    page.browser.refresh()
    page.says(".trials-card", before[1])
    assert (column(page, "trial"), num_trials(page), page.text(".curves .keys")) == before


def test_a_range_on_an_axis_keeps_the_table_to_its_trials(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo", height=1400)
    page.says(".trials-card", "60 trials")
    grip = page.one(".grip[data-axis=lr]")
    page.drag(grip, (20, 20), (0, 30), (0, 40))
    assert page.address().startswith("#/sweeps/cartpole-ppo?in.lr=")
    few = int(num_trials(page).split()[0])
    assert 0 < few < 60
    page.drag(grip, (20, 40), (0, 0))
    page.says(".trials-card", "60 trials")
    # The same by keys: the upper end goes down.
    handle = page.browser.find_element(By.CSS_SELECTOR, ".handle[data-axis=lr][data-end=high]")
    page.run("arguments[0].focus()", handle)
    page.keys(*[Keys.ARROW_DOWN] * 12)
    assert int(num_trials(page).split()[0]) < 60
    assert handle.get_attribute("aria-valuetext")
    page.keys(Keys.ESCAPE)
    page.says(".trials-card", "60 trials")


def test_a_trial_opens_with_why_it_failed_and_its_log(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo?filter=status%3Dfailed")
    page.says(".trials-card", "2 of 60 trials")
    page.one(".trials tbody th").click()
    trial = page.text("#trial-title")
    assert f"trial={trial}" in page.address()
    page.says(".panel .why", HOSTILE)
    page.says(".panel [role=log]", "iteration 5: 5120 env steps")
    page.says(".panel", "hidden_sizes")
    assert page.focused() == trial
    page.one(".panel button[aria-label^=Next]").click()
    page.until(lambda: page.text("#trial-title") != trial)
    assert page.text("#trial-title") in page.address()
    page.keys(Keys.ESCAPE)
    page.until(lambda: "trial=" not in page.address())
    assert page.run("return document.activeElement.tagName") == "TR"


def test_the_panel_keeps_the_focus_inside_on_a_phone(page: Page) -> None:
    page.open(FAILED, width=400)
    page.says(".panel", "Why it failed")
    outside = "return document.activeElement !== document.body && !document.activeElement.closest('.panel')"
    for _ in range(20):
        page.keys(Keys.TAB)
        assert not page.run(outside)


def test_a_sweep_file_is_planned_and_what_is_wrong_is_shown_at_its_line(page: Page) -> None:
    page.open("#/new?preset=cartpole-ppo")
    page.says(".plan", "valid")
    page.says(".plan", "20 points")
    area = page.one("#sweep-file")
    area.click()
    area.send_keys(Keys.CONTROL, "a")
    area.send_keys(Keys.DELETE)
    area.send_keys("env: CartPole-v1", Keys.ENTER, "algorithm: ppo", Keys.ENTER, "num_sample: 3", Keys.ENTER)
    page.says(".plan", "Did you mean 'num_samples'?")
    page.button("line 3").click()
    assert page.run("return getSelection().toString() || document.activeElement.id") in ("num_sample: 3", "sweep-file")
    assert page.text(".numbers .bad") == "3"
    area.send_keys(Keys.BACKSPACE, "num_samples: 3")
    page.says(".plan", "valid")
    page.says(".plan", "3 points")
    # A draft is there again after a reload.
    page.browser.refresh()
    page.says(".plan", "3 points")


def test_keys_and_values_are_completed_from_the_schema(page: Page) -> None:
    page.open("#/new")
    page.says(".plan", "valid")
    area = page.one("#sweep-file")
    area.click()
    area.send_keys(Keys.CONTROL, "a")
    area.send_keys(Keys.DELETE)
    area.send_keys("env: CartPole-v1", Keys.ENTER, "algo")
    page.says("#offers", "algorithm")
    area.send_keys(Keys.ENTER)
    area.send_keys("p")
    page.says("#offers", "ppo")
    area.send_keys(Keys.ARROW_DOWN, Keys.ARROW_UP, Keys.ENTER, Keys.ENTER, "spa")
    page.says("#offers", "space")
    area.send_keys(Keys.ENTER, "gae")
    page.says("#offers", "gae_lambda")
    area.send_keys(Keys.ENTER, "uni")
    page.says("#offers", "uniform")
    area.send_keys(Keys.ENTER, "0.9, 0.99")
    wanted = "env: CartPole-v1\nalgorithm: ppo\nspace:\n  gae_lambda: {uniform: [0.9, 0.99]}"
    assert page.run("return arguments[0].value", area) == wanted
    page.says(".plan", "valid")


def test_a_sweep_is_submitted_stopped_and_refused_with_a_sentence(page: Page) -> None:
    page.open("#/new")
    page.says(".plan", "valid")
    page.one("#name").send_keys("from-the-page")
    page.one("#tags").send_keys("one, two")
    page.button("Submit sweep").click()
    page.says("main h1", "from-the-page")
    page.says(".sweep-title", "waiting")
    assert "two" in page.text(".tag-line")
    # The name is taken now, and said to be before it is submitted.
    page.open("#/new")
    page.says(".plan", "valid")
    page.one("#name").send_keys("from-the-page")
    page.says(".plan", "A sweep 'from-the-page' is already in")
    page.button("Submit sweep").click()
    page.says(".submit .problem", "from-the-page")
    page.one("#name").send_keys("-again")
    page.says(".plan", "valid")
    page.open("#/sweeps/from-the-page")
    page.button("Stop").click()
    page.says(".sweep-title", "stopped")
    # Somebody else was faster.
    page.run("document.querySelector('[data-action=stop]').click()")
    page.says("[role=alert]", "Sweep from-the-page neither waits nor runs")
    page.button("Close", "[role=alert]").click()
    assert page.text("[role=alert]") == ""
    # One from a preset has its name, with a number if that is taken.
    page.open("#/new?preset=cartpole-ppo")
    page.says(".plan", "20 points")
    page.button("Submit sweep").click()
    page.says("main h1", "cartpole-ppo-2")


def test_dialogs_show_what_is_refused_and_change_what_is_not(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo")
    page.button("More").click()
    page.button("Extend…").click()
    assert page.focused() == "More samples"
    page.one("dialog input").send_keys("9999")
    for _ in range(12):
        page.keys(Keys.TAB)
        inside = "return document.activeElement === document.body || document.activeElement.closest('dialog') !== null"
        assert page.run(inside)
    page.button("Extend", "dialog").click()
    page.says("dialog [role=alert]", "here a sweep may have at most 10,000")
    page.keys(Keys.ESCAPE)
    page.wait("return document.querySelector('.dialog') === null")
    page.open("#/sweeps/pendulum-no-space")
    page.button("More").click()
    page.button("Note, tags, priority…").click()
    page.one("dialog textarea").send_keys(f"A note {HOSTILE}")
    page.one("dialog #field-tags").send_keys("baseline, baseline")
    # Nothing of it waits for a turn.
    assert page.text(".dialog h2") == "Note and tags of pendulum-no-space"
    assert not page.browser.find_elements(By.CSS_SELECTOR, "dialog #field-priority")
    page.button("Save", "dialog").click()
    page.says(".note", HOSTILE)
    page.says(".tag-line", "baseline")


def test_the_priority_of_what_waits_is_changed(page: Page, live: Live) -> None:
    body = {"preset": "cartpole-ppo", "name": "waits", "priority": 3}
    assert httpx2.post(f"{live.url}/api/v1/sweeps", json=body, timeout=60).status_code == 201
    page.open("#/sweeps/waits")
    page.says(".sweep-title", "waiting")
    page.button("More").click()
    page.button("Note, tags, priority…").click()
    assert page.text(".dialog h2") == "Note, tags and priority of waits"
    field = page.one("dialog #field-priority")
    assert field.get_attribute("value") == "3"
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys("7")
    page.button("Save", "dialog").click()
    page.wait("return document.querySelector('.dialog') === null")
    assert [job.priority for job in live.service.queue.jobs(sweep="waits")] == [7]


def test_a_submission_has_another_key_once_the_text_is_another(page: Page) -> None:
    page.open("#/new")
    page.says(".plan", "valid")
    page.run(LOST)
    # Faster than the text is looked at, which is so a moment after the last key.
    page.run("window.type('# one'); window.submit();")
    page.says(".submit .problem", "The service can't be reached.")
    page.wait("return window.numPlans > 0")
    page.run("window.submit();")
    page.wait("return window.keys.length === 2")
    page.wait("return !document.querySelector('form.submit [type=submit]').disabled")
    page.run("window.type(' and two'); window.submit();")
    page.wait("return window.keys.length === 3")
    first, again, other = page.run("return window.keys")
    assert first == again != other


def test_a_plan_that_had_no_turn_is_asked_for_again(page: Page, live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live.service.planning, "wait_s", 0.1)
    monkeypatch.setattr(live.service.planning, "at_once", 0)
    page.open("#/new")
    page.says(".plan", "Too many sweeps are being planned")
    monkeypatch.undo()
    page.says(".plan", "valid")


def test_a_sweep_is_deleted_only_when_it_was_meant(page: Page, live: Live) -> None:
    from page_sweeps import write_sweep
    from synthetic_sweep import make_sweep

    made = make_sweep(name="to-delete", points=[{}], with_best=False)
    write_sweep(live.storage, made, state="interrupted", spec={"space": {}})
    page.open("#/sweeps/to-delete")
    page.button("More").click()
    page.button("Delete…").click()
    page.button("Delete", "dialog").click()
    page.says("dialog [role=alert]", "has not finished")
    page.one("dialog input[type=checkbox]").click()
    page.button("Delete", "dialog").click()
    page.says("main h1", "Sweeps")
    page.wait("return ![...document.querySelectorAll('.sweeps a')].some((link) => link.innerText === 'to-delete')")
    assert not (live.storage / "to-delete").exists()


def test_what_trials_report_shows_up_by_itself(page: Page, live: Live) -> None:
    from page_sweeps import write_sweep
    from synthetic_sweep import make_sweep

    made = make_sweep(name="live", points=[{"lr": 1e-3}, {"lr": 1e-2}], with_best=False, max_steps=20_000)
    store = write_sweep(
        live.storage, made, state="running", ended_at=None, spec={"space": {"lr": {"grid": [1e-3, 1e-2]}}}
    )
    trial = store.trial("t0001")
    record = trial.read_record()
    rows = trial.read_iterations()
    trial.write_record(record.model_copy(update={"status": "running", "ended_at": None}))
    with store.lock():
        page.open("#/sweeps/live")
        page.says(".sweep-title", "running")
        page.says(".trials", "running")
        last = rows[-1].model_copy(
            update={"iteration": len(rows) + 1, "num_env_steps": 30_000, "training_return": 654.3}
        )
        trial.append_iterations([last])
        progress = {"status": "running", "ended_at": None, "num_env_steps": 30_000, "training_return": 654.3}
        trial.write_record(record.model_copy(update=progress))
        page.says(".trials", "654.3")
        page.wait("""return document.querySelector(".curves .keys")?.innerText.includes("654.3")""")
    store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))
    page.says(".sweep-title", "interrupted")


def test_a_table_of_ten_thousand_trials_scrolls_and_sorts(page: Page, live: Live) -> None:
    write_large(live.storage)
    page.open("#/sweeps/large")
    page.says(".trials-card", "10,000 trials")
    rows = "return document.querySelectorAll('.trials tbody tr:has(th)').length"
    assert page.run(rows) < 80
    assert page.one(".trials").get_attribute("aria-rowcount") == "10001"
    page.run("document.querySelector('.scroller').scrollTop = 1e7")
    page.wait("return document.querySelector('.trials tr[aria-rowindex=\"10001\"]') !== null")
    assert page.run(rows) < 80
    page.button("trial", ".trials").click()
    page.run("document.querySelector('.scroller').scrollTop = 0")
    page.until(lambda: column(page, "trial")[:2] == ["t0000", "t0001"])
    page.run("document.querySelector('.trials tr[tabindex=\"0\"]').focus()")
    page.keys(Keys.END)
    page.until(lambda: page.run("return document.activeElement.dataset.key") == "t9999")
    page.keys(Keys.ARROW_UP, Keys.ENTER)
    page.says(".panel", "t9998")
    page.one(".trials-card input[type=search]").send_keys("score>199.9")
    page.until(lambda: 0 < int(num_trials(page).split()[0].replace(",", "")) < 100)
    page.open("#/")
    page.says("main", "large")
