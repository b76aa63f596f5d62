"""What the service's page asks for again where it did not come, and where a sweep is another one of the same name."""

from collections.abc import Iterator
from typing import Any

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from synthetic_sweep import make_sweep

from tune_jobs.service import watching
from tune_jobs.store.sweep_store import SweepStore

pytestmark = IN_A_BROWSER
POINTS = [{"lr": lr} for lr in (1e-5, 3e-3, 2e-2)]
COST = {"objective": {"type": "final", "cost": "env_steps"}, "space": {"lr": {"loguniform": [1e-6, 1e-1]}}}
DRAFT = "env: Acrobot-v1\\nalgorithm: ppo\\nstop: {num_env_steps: 5_000}\\n"
BROKEN = """
    // What is waited for comes soon.
    const later = window.setTimeout;
    window.setTimeout = (act, ms, ...given) => later(act, ms >= 5000 ? 200 : ms, ...given);
    const ask = window.fetch;
    [window.code, window.paths] = arguments;
    window.asked = {};
    window.fetch = async (url, options) => {
      const path = new URL(url).pathname.split("/").at(-1);
      window.asked[path] = (window.asked[path] ?? 0) + 1;
      const isBroken = window.paths === "all" || window.paths[path] > 0;
      if (!isBroken) return ask(url, options);
      if (window.paths !== "all") window.paths[path] -= 1;
      if (window.code === 0) throw new TypeError("Failed to fetch");
      return new Response(JSON.stringify({ detail: "The service is away." }), { status: window.code });
    };
"""
IMPORTANCE = """
    const ticks = [];
    window.setTimeout = (act, ms) => ticks.push([act, ms]);
    window.clearTimeout = (id) => { if (id) ticks[id - 1] = null; };
    const told = (names) => ({
      hyperparams: names.map((name) => ({ name, share: 0.5, low: null, high: null, is_clear: true })),
      too_few: "", interactions: [], edges: [], notes: [],
    });
    const answers = given.answers.map((names) => () => {
      if (names === "away") throw new Unreachable();
      if (names === "refused") throw new Refused(404, { detail: "There is none." });
      return told(names);
    });
    const { Unreachable, Refused } = await import(new URL("static/js/api.js", document.baseURI));
    const source = { isFile: given.isFile ?? false, importance: async () => answers.shift()() };
    const host = document.createElement("section");
    document.querySelector("main").replaceChildren(host);
    const card = new module.ImportanceCard(host, source);
    const seen = [];
    for (const step of given.steps) {
      if (step === "forget") card.forget();
      else if (step === "wait") {
        const tick = ticks.findLast((each) => each);
        ticks.length = 0;
        tick[0]();
        // The answer comes at once.
        for (let turn = 0; turn < 20; turn += 1) await null;
      } else if (step === "close") card.close();
      else await card.follow({ state: "completed", num_trials: step, counts: { completed: step } });
      const names = [...host.querySelectorAll(".name")].map((node) => node.innerText);
      const caption = host.querySelector("p").innerText.split(".")[0];
      seen.push([caption, names, answers.length, ticks.filter((each) => each).map(([, ms]) => ms)]);
    }
    return seen;
"""
AWAY = "The service can't be reached"
SHARES = "The share of the points' ranks that each accounts for by itself, with its 95 % interval; grey: may be chance"


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service of a finished sweep with a policy."""
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    store = write_sweep(storage, make_sweep(name="mine", points=POINTS, max_steps=20_000), spec=COST)
    for name in ("policy.json", "policy.safetensors"):
        (store.best_folder / name).write_text("{}")
    with serving(storage) as found:
        yield found


@pytest.fixture
def importance(page: Page) -> Any:
    """The card of what mattered, with what it is answered and what is done with it, step by step."""

    def told(**given: Any) -> list[Any]:
        page.open("#/file")
        made = f"""
            const [given, done] = arguments;
            import(new URL("static/js/importance.js", document.baseURI))
              .then(async (module) => {{ {IMPORTANCE} }}).then(done, (error) => done(String(error)));
        """
        found: list[Any] = page.browser.execute_async_script(made, given)
        return found

    return told


@pytest.mark.parametrize("status", [0, 503])
def test_what_a_finished_sweep_came_to_is_asked_for_until_it_is_there(page: Page, status: int) -> None:
    page.open("#/new")
    page.run(BROKEN, status, {"importance": 2, "front": 2, "files": 2})
    page.run("location.hash = '#/sweeps/mine'")
    page.says(".finished h2", "Result")
    page.says(".front", "The cheapest near the best:")
    page.until(lambda: page.run("return window.asked.importance") == 3)
    page.until(lambda: "service" not in page.text(".importance"))
    # Nothing is asked for that is there.
    page.browser.execute_async_script("setTimeout(arguments[0], 600)")
    assert page.run("return [window.asked.importance, window.asked.front, window.asked.files]") == [3, 3, 3]


def test_shares_that_are_there_stay_until_there_are_others(importance: Any) -> None:
    # An answer that does not come is asked for after 5 s, then after 10 s, and not with each look in between.
    told = importance(answers=[["lr"], "away", "away", ["gamma"]], steps=[8, 16, 16, 17, "wait", "wait", 17])
    assert told == [
        [SHARES, ["lr"], 3, []],
        [SHARES, ["lr"], 2, [5000]], [SHARES, ["lr"], 2, [5000]], [SHARES, ["lr"], 2, [5000]],
        [SHARES, ["lr"], 1, [10000]],
        [SHARES, ["gamma"], 0, []], [SHARES, ["gamma"], 0, []],
    ]  # fmt: skip


def test_what_will_not_come_is_not_asked_for_again(importance: Any) -> None:
    assert importance(answers=["refused", ["lr"]], steps=[8, 8]) == [["There is none", [], 1, []]] * 2
    assert importance(answers=["away", ["lr"]], steps=[8, 8], isFile=True) == [[AWAY, [], 1, []]] * 2
    assert importance(answers=["away"], steps=[8, "close"]) == [[AWAY, [], 0, [5000]], [AWAY, [], 0, []]]


def test_shares_of_another_sweep_of_the_name_are_forgotten(importance: Any) -> None:
    told = importance(answers=[["lr"], ["gamma"]], steps=[8, "forget", 8])
    assert told == [[SHARES, ["lr"], 1, []], ["", [], 1, []], [SHARES, ["gamma"], 0, []]]
    assert importance(answers=["away", ["gamma"]], steps=[8, "forget", 8])[1:] == [
        ["", [], 1, []], [SHARES, ["gamma"], 0, []],
    ]  # fmt: skip


def test_another_sweep_of_the_name_is_shown_with_its_own_file(
    page: Page, live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "LINGER_S", 0.2)
    made = make_sweep(name="twice", points=POINTS, with_best=False, max_steps=5_000)
    write_sweep(live.storage, made, spec=COST)
    page.open("#/new")
    page.run(BROKEN, 0, {})
    page.run("location.hash = '#/sweeps/twice'")
    page.says(".front", "The cheapest near the best:")
    SweepStore(live.storage / "twice").discard()
    page.says("[role=alert]", "Sweep twice was deleted.")
    points = [{"gae_lambda": value} for value in (0.9, 0.99, 0.999)]
    made = make_sweep(name="twice", points=points, env_id="CartPole-v1", with_best=False, max_steps=5_000)
    spec = COST | {"space": {"gae_lambda": {"one_minus_loguniform": [0.9, 0.999]}}}
    write_sweep(live.storage, made, spec=spec, created_at=made.sweep.created_at + 50)
    page.says(".sweep-title", "CartPole-v1")
    assert page.text(".sweep-page [role=alert]") == ""
    ticks = "[...document.querySelectorAll('[data-axis=gae_lambda] .tick text')].map((node) => node.textContent)"
    # As far apart as the sweep file says; without one each value is a tick, with the same distances.
    page.until(lambda: page.run(f"return {ticks}") == ["0.999", "0.99", "0.9"])
    page.until(lambda: page.run("return [window.asked.importance, window.asked.front]") == [2, 2])
    page.says(".front", "The cheapest near the best:")
    assert "gae_lambda" in page.text(".front table")


@pytest.mark.parametrize(("status", "told"), [(0, "goes on by itself once it answers"), (502, "goes on by itself")])
def test_a_new_sweep_is_written_while_the_service_is_away(page: Page, status: int, told: str) -> None:
    page.open("#/file")
    page.run(f"sessionStorage.setItem('tune-jobs draft', '{DRAFT}')")
    page.run(BROKEN, status, "all")
    page.run("location.hash = '#/new'")
    page.says(".submit .problem", told)
    text = "return document.querySelector('#sweep-file').value"
    write = """
        const area = document.querySelector("#sweep-file");
        area.setRangeText(arguments[0], 0, 0, "end");
        area.dispatchEvent(new Event("input", { bubbles: true }));
    """
    draft = DRAFT.replace("\\n", "\n")
    assert page.run(text) == draft
    page.run(write, "# more\n")
    page.says(".plan", told)
    page.run("window.paths = {}")
    page.wait("return document.querySelectorAll('#preset option').length > 1")
    page.says(".plan", "valid")
    assert page.run(text) == f"# more\n{draft}"
    assert page.run("return document.querySelector('#sweep-file').selectionStart") == len("# more\n")
    assert page.text(".submit .problem") == ""
    page.run("window.paths = 'all'")
    page.run(write, "# again\n")
    page.says(".plan", told)
    page.run("window.paths = {}")
    page.says(".plan", "valid")


@pytest.mark.parametrize("status", [0, 503])
def test_who_wants_to_watch_is_let_in_once_the_service_is_back(page: Page, status: int) -> None:
    page.open("#/new")
    page.run(BROKEN, status, "all")
    page.run("location.hash = '#/sweeps/mine/play'")
    page.says(".notice.bad", "The page goes on by itself" if status else "the page goes on by itself")
    page.run("window.paths = {}")
    page.says("main", "CartPole-v0")
    assert page.one(".play-controls").is_displayed()
    assert not page.browser.find_elements("css selector", "main > [role=alert] .notice")


def test_what_somebody_sends_is_not_said_to_go_on_by_itself(page: Page) -> None:
    page.open("#/sweeps/mine")
    page.button("More").click()
    page.button("Note, tags, priority…").click()
    page.run(BROKEN, 0, "all")
    page.button("Save", "dialog").click()
    page.says("dialog [role=alert]", "The service can't be reached.")
    page.says("dialog [role=alert]", "Check that it runs, then try again.")
    assert "by itself" not in page.text("dialog")
