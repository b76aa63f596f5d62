// Watch a policy play, and another one beside it. The address says which ones, the seed and the speed.
import { Again } from "./again.js";
import { ask, ofSweep } from "./api.js";
import { awaited } from "./dialogs.js";
import { el, setText } from "./dom.js";
import { Player } from "./player.js";
import { policiesOf, policyOf, settled, textOf, usual } from "./play_policies.js";
import { PolicyPicker } from "./policy_picker.js";
import { keep, sweepAddress } from "./route.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 10];
const MOST_SEED = 2 ** 32 - 1;
// How long one that is held still keeps its place among those that the service plays at once.
export const held = { ms: 30_000 };
// Who clicks through seeds or policies starts a process for the last one alone.
const START_MS = 200;
const REDUCED = matchMedia("(prefers-reduced-motion: reduce)");

function seenOf(params) {
  const seed = Number(params.seed ?? 0);
  const speed = Number(params.speed ?? 1);
  return {
    policy: policyOf(params.trial, params.iteration),
    other: policyOf(params.with),
    seed: Number.isInteger(seed) && seed >= 0 && seed <= MOST_SEED ? seed : 0,
    speed: speed >= SPEEDS[0] && speed <= SPEEDS.at(-1) ? speed : 1,
  };
}

// `arrive()` is called by as many as there are; all of them go on when the last one has come.
function meeting(number) {
  let left = number;
  let open;
  const all = new Promise((resolve) => {
    open = resolve;
  });
  return () => {
    left -= 1;
    if (left <= 0) open();
    return all;
  };
}

export function openPlay(main, route) {
  const { name } = route;
  let seen = seenOf(route.params);
  let known = null;
  let isRunning = false;
  let isClosed = false;
  let holding = 0;
  let starting = 0;
  const players = [];

  const what = el("p", { class: "quiet" }, el("a", { href: sweepAddress(name) }, name));
  const problem = el("div", { role: "alert" });
  const toggle = el("button", { type: "button", class: "primary", onclick: () => (isRunning ? pause() : press()) });
  const again = el("button", { type: "button", onclick: () => restart(true) }, "Play again");
  const seed = el("input", { id: "seed", type: "number", min: 0, max: MOST_SEED, step: 1, required: true });
  const next = el(
    "button",
    { type: "button", onclick: () => change({ seed: seen.seed < MOST_SEED ? seen.seed + 1 : 0 }) },
    "Next seed",
  );
  const speed = el("select", { id: "speed" });
  const who = el("div", { class: "play-policies" });
  const picker = new PolicyPicker(who, {
    id: "policy",
    label: "Policy",
    onChange: (policy) => change({ policy }),
  });
  const otherPicker = new PolicyPicker(who, {
    id: "other",
    label: "Compare with",
    none: "nothing",
    onChange: (other) => change({ other }),
  });
  const controls = el(
    "section",
    { class: "card play-controls", "aria-label": "Controls", hidden: true },
    who,
    el(
      "div",
      { class: "play-run" },
      el("div", { class: "field" }, el("label", { for: "seed" }, "Seed of the episode"), el("div", {}, seed, next)),
      el("div", { class: "field" }, el("label", { for: "speed" }, "Speed"), speed),
      el("div", { class: "play-buttons" }, toggle, again),
    ),
  );
  const stages = el("div", { class: "players" });
  const loading = el("p", { class: "empty quiet", role: "status" }, "Loading…");
  main.append(
    el("div", { class: "title-row" }, el("div", {}, el("h1", {}, "Watch it play"), what)),
    problem,
    controls,
    loading,
    stages,
  );

  seed.addEventListener("change", () => {
    if (!seed.reportValidity()) return;
    change({ seed: seed.valueAsNumber });
  });
  speed.addEventListener("change", () => changeSpeed(Number(speed.value)));

  const policies = () => [seen.policy, seen.other].filter((policy) => policy !== null);

  function change(changes) {
    Object.assign(seen, changes);
    keepAddress();
    showControls();
    restart(isRunning);
  }

  function keepAddress() {
    const { policy, other } = seen;
    const isTrial = policy.kind === "trial";
    keep({
      trial: policy.kind === "best" && known.hasBest ? null : isTrial ? policy.trial : policy.kind,
      iteration: isTrial ? policy.iteration : null,
      seed: seen.seed || null,
      speed: seen.speed === 1 ? null : seen.speed,
      with: textOf(other),
    });
  }

  // The steps that were seen stay; the service goes on with the others in another time.
  function changeSpeed(to) {
    seen.speed = to;
    keepAddress();
    for (const player of players) {
      player.halt();
      player.speed = to;
    }
    if (isRunning) play();
  }

  function showControls() {
    picker.show(known, seen.policy);
    otherPicker.show(known, seen.other);
    seed.value = seen.seed;
    const offered = [...new Set([...SPEEDS, seen.speed])].sort((a, b) => a - b);
    speed.replaceChildren(...offered.map((value) => el("option", { value }, `${value} ×`)));
    speed.value = seen.speed;
    showState();
  }

  function showState() {
    setText(toggle, isRunning ? "Pause" : "Play");
    again.disabled = players.every((player) => player.state === "idle");
  }

  function changed() {
    if (isClosed) return;
    if (players.length && players.every((player) => player.isOver || player.state === "failed")) isRunning = false;
    showState();
  }

  // From the beginning; what moves by itself waits for those who asked their system for less of it.
  function restart(isWanted) {
    clearTimers();
    const wanted = policies();
    while (players.length > wanted.length) players.pop().close();
    while (players.length < wanted.length)
      players.push(new Player(stages, { sweep: name, onChange: changed, onRefused: refused }));
    stages.classList.toggle("two", players.length > 1);
    players.forEach((player, index) => player.load({ policy: wanted[index], seed: seen.seed, speed: seen.speed }));
    isRunning = isWanted || !REDUCED.matches;
    if (isRunning) starting = setTimeout(play, START_MS);
    showState();
  }

  function clearTimers() {
    clearTimeout(holding);
    clearTimeout(starting);
  }

  function press() {
    if (players.every((player) => player.isOver)) restart(true);
    else play();
  }

  function play() {
    clearTimers();
    isRunning = true;
    for (const player of players) player.resume();
    const waiting = players.filter((player) => !player.isOver && !player.isStreaming);
    const arrive = meeting(waiting.length);
    if (!document.hidden) for (const player of waiting) player.play(arrive);
    showState();
  }

  function pause() {
    clearTimers();
    isRunning = false;
    for (const player of players) player.pause();
    holding = setTimeout(() => players.forEach((player) => player.halt()), held.ms);
    showState();
  }

  // Checkpoints come and go while a sweep runs.
  async function refused(error) {
    if (error.status !== 404) return;
    const found = await policiesOf(name, policies()).catch(() => null);
    if (isClosed || found === null) return;
    known = found;
    showControls();
  }

  // Nobody looks: no process plays on for them.
  const halt = () => players.forEach((player) => player.halt());
  function looked() {
    if (document.hidden) halt();
    else if (isRunning) play();
  }
  const shown = (event) => event.persisted && looked();
  document.addEventListener("visibilitychange", looked);
  addEventListener("pagehide", halt);
  addEventListener("pageshow", shown);

  const waiting = new Again(load);

  async function load() {
    let summary;
    try {
      [summary, known] = await Promise.all([ask(ofSweep(name)), policiesOf(name, policies())]);
    } catch (error) {
      if (isClosed) return;
      problem.replaceChildren(el("div", { class: "notice bad" }, ...awaited(error)));
      waiting.failed(error);
      return;
    } finally {
      loading.hidden = true;
    }
    if (isClosed) return;
    problem.replaceChildren();
    what.append(` · ${summary.env} · ${summary.algorithm}`);
    begin();
  }

  function begin() {
    seen.policy = settled(seen.policy ?? usual(known), known);
    seen.other = settled(seen.other, known);
    controls.hidden = false;
    keepAddress();
    showControls();
    restart(false);
  }

  load();
  return {
    follow(params) {
      seen = seenOf(params);
      if (known !== null) begin();
    },
    close() {
      isClosed = true;
      waiting.close();
      clearTimers();
      document.removeEventListener("visibilitychange", looked);
      removeEventListener("pagehide", halt);
      removeEventListener("pageshow", shown);
      for (const player of players) player.close();
    },
  };
}
