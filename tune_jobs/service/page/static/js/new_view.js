// A new sweep: the sweep file in an editor, what is wrong with it, what would run, and what else there is to say of it.
import { tagsOf } from "./actions.js";
import { Again, mayPass } from "./again.js";
import { ask, randomKey, Unreachable } from "./api.js";
import { Completion } from "./completion.js";
import { askInDialog, awaited, GOES_ON, refusal } from "./dialogs.js";
import { el, setText, toast } from "./dom.js";
import { Editor } from "./editor.js";
import { PlanCard } from "./plan_card.js";
import { keep, sweepAddress } from "./route.js";
import { maySubmit, me } from "./who.js";
import { lineOfPath } from "./yaml_lines.js";

const PAUSE_MS = 400;
// When it is asked again after the service had no turn for it, or was away.
const AGAIN_MS = 10_000;
const DRAFT = "tune-jobs draft";
const FIRST =
  "env: CartPole-v1\nalgorithm: ppo\n\nspace:\n  lr: {loguniform: [0.0001, 0.01]}\n\nnum_samples: 8\n\nstop:\n  num_env_steps: 50_000\n";

export function openNew(main, route) {
  let presets = [];
  let timer = 0;
  let asked = null;
  let key = randomKey();
  let isClosed = false;

  const choice = el("select", { id: "preset" }, el("option", { value: "" }, "a small search"));
  const about = el("p", { class: "quiet small", id: "about" });
  const plan = new PlanCard({ onLine: (line) => editor.goTo(line) });
  const field = (name, label, attributes, hint) =>
    el(
      "div",
      { class: "field" },
      el("label", { for: name }, label),
      el(attributes.rows ? "textarea" : "input", {
        id: name,
        name,
        autocomplete: "off",
        ...attributes,
        "aria-describedby": hint ? `${name}-hint` : null,
      }),
      hint ? el("small", { id: `${name}-hint` }, hint) : null,
    );
  const problem = el("div", { class: "problem", role: "alert" });
  const submit = el("button", { type: "submit", class: "primary" }, "Submit sweep");
  const form = el(
    "form",
    { class: "card submit" },
    el("h2", {}, "Submit"),
    field(
      "name",
      "Name",
      { type: "text", maxlength: 200, spellcheck: "false" },
      "Empty: the file's or the preset's, with a number if it is taken.",
    ),
    field(
      "priority",
      "Priority",
      { type: "number", min: -100, max: 100, step: 1, value: 0, required: true },
      "Higher ones go first.",
    ),
    field("tags", "Tags", { type: "text", maxlength: 1000 }, "Separated by commas."),
    field("note", "Note", { rows: 2, maxlength: 2000 }),
    ...(me.address === null
      ? []
      : [
          field(
            "wait_for_nodes",
            "Wait for nodes, seconds",
            { type: "number", min: 0, max: 1e9, step: 1 },
            "At most, until the cluster can hold one trial. Empty: as the service's operator has said.",
          ),
        ]),
    problem,
    el("div", { class: "buttons" }, submit),
  );
  const editing = el(
    "section",
    { class: "card editing", "aria-label": "Sweep file" },
    el("div", { class: "card-head" }, el("h2", {}, "Sweep file"), el("label", { for: "preset" }, "Start from"), choice),
    about,
  );
  main.append(
    el("div", { class: "title-row" }, el("h1", {}, "New sweep")),
    ...(maySubmit()
      ? []
      : [el("p", { class: "notice" }, `The token of ${me.name} is a viewer's: it may look, and submit nothing.`)]),
    el("div", { class: "new" }, editing, el("div", { class: "beside" }, plan.node, form)),
  );
  const editor = new Editor(editing, { label: "Sweep file, YAML", onChange: changed });

  // What is submitted twice by accident is one sweep; what was changed since is another one.
  function changed() {
    key = randomKey();
    sessionStorage.setItem(DRAFT, editor.text);
    later(PAUSE_MS);
  }

  function later(pauseMs) {
    clearTimeout(timer);
    timer = setTimeout(check, pauseMs);
  }

  // A preset that was changed is named after it, too.
  const names = () => ({ name: form.elements.name.value.trim() || null, default_name: choice.value || null });

  form.addEventListener("input", (event) => {
    key = randomKey();
    if (event.target === form.elements.name) later(PAUSE_MS);
  });

  async function check() {
    if (!maySubmit()) return;
    asked?.abort();
    asked = new AbortController();
    const text = editor.text;
    plan.wait();
    try {
      const found = await ask("plans", { method: "POST", body: { text, ...names() }, signal: asked.signal });
      editor.mark(new Map());
      plan.show(found);
    } catch (error) {
      if (error.name === "AbortError" || isClosed) return;
      // It is no submission: what was away is asked again.
      const problems = problemsOf(error instanceof Unreachable ? new Unreachable() : error, text);
      editor.mark(new Map(problems.filter((item) => item.line !== null).map((item) => [item.line, item.text])));
      plan.refuse(problems, error.status >= 500 ? GOES_ON : "");
      if (mayPass(error)) later(AGAIN_MS);
    }
  }

  function load(text, name) {
    key = randomKey();
    editor.text = text;
    choice.value = name;
    describe(name);
    keep({ preset: name });
    sessionStorage.removeItem(DRAFT);
    check();
  }

  function describe(name) {
    const preset = presets.find((item) => item.name === name);
    setText(
      about,
      preset
        ? [
            preset.title,
            preset.shows && `Shows ${preset.shows}`,
            preset.expected && `Expected: ${preset.expected}`,
            preset.time && `Takes ${preset.time}`,
          ]
            .filter(Boolean)
            .map((part) => part.replace(/([^.?!])$/, "$1."))
            .join(" ")
        : "",
    );
  }

  const textOf = (name) => presets.find((item) => item.name === name)?.text ?? FIRST;

  choice.addEventListener("change", () => {
    const name = choice.value;
    const known = [FIRST, ...presets.map((item) => item.text)];
    if (known.includes(editor.text) || !editor.text.trim()) {
      load(textOf(name), name);
      return;
    }
    askInDialog({
      title: "Replace what is written?",
      text: "The editor's text is lost then.",
      label: "Replace",
      isDangerous: true,
      act: async () => load(textOf(name), name),
    }).addEventListener("close", () => {
      choice.value = routePreset();
    });
  });
  const routePreset = () => new URLSearchParams(location.hash.split("?")[1] ?? "").get("preset") ?? "";

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    submit.disabled = true;
    problem.replaceChildren();
    const { priority, tags, note, wait_for_nodes: wait } = form.elements;
    try {
      const body = {
        text: editor.text,
        ...names(),
        priority: Number(priority.value),
        tags: tagsOf(tags.value),
        note: note.value,
        wait_for_nodes: wait?.value ? Number(wait.value) : null,
      };
      const made = await ask("sweeps", { method: "POST", body, headers: { "Idempotency-Key": key } });
      sessionStorage.removeItem(DRAFT);
      toast(`${made.sweep} is submitted.`);
      // Who has gone elsewhere meanwhile stays there.
      if (!isClosed) location.hash = sweepAddress(made.sweep);
    } catch (error) {
      problem.replaceChildren(...refusal(error));
      submit.disabled = false;
    }
  });
  submit.disabled = !maySubmit();

  // Before anything else may fail: who goes on writing goes on from it.
  editor.text = sessionStorage.getItem(DRAFT) ?? "";
  const again = new Again(begin);

  async function begin() {
    let found, schema;
    try {
      [schema, found] = await Promise.all([ask("schema"), ask("presets")]);
    } catch (error) {
      if (isClosed) return;
      problem.replaceChildren(...awaited(error));
      again.failed(error);
      return;
    }
    if (isClosed) return;
    if (again.failures) problem.replaceChildren();
    again.reset();
    presets = found;
    editor.completion = new Completion(schema);
    choice.append(...found.map((item) => el("option", { value: item.name }, `${item.name}: ${item.title}`)));
    const wanted = route.params.preset ?? "";
    choice.value = wanted;
    if (wanted && choice.value !== wanted) choice.value = "";
    // What was written meanwhile is the draft.
    editor.text = sessionStorage.getItem(DRAFT) ?? textOf(choice.value);
    describe(choice.value);
    check();
  }
  begin();

  return {
    close() {
      isClosed = true;
      clearTimeout(timer);
      again.close();
      asked?.abort();
    },
  };
}

// The problems of a text, each with its line (0 is the first) where that is known.
function problemsOf(error, text) {
  const listed = error.problems ?? [];
  if (listed.length)
    return listed.map((item) => ({ path: item.path, text: item.text, line: lineOfPath(text, item.path) }));
  const place = /line (\d+)/.exec(error.message);
  const field = /^([a-z_]+(?:\.[\w]+)*):/.exec(error.message);
  const line = place ? Number(place[1]) - 1 : field ? lineOfPath(text, field[1]) : null;
  return [{ path: "", text: error.message, line, hint: error.hint }];
}
