// Dialogs with a few fields: the browser keeps the focus inside and gives it back.
import { el, setText } from "./dom.js";

// A field: { name, label, type: "number" | "text" | "textarea" | "checkbox" | "select", value, min, max, hint }; a number may
// have a `step`, 1 if left out, and a select has `options`: { text, value }, of which the value may be anything.
// A field with `acts(values)` is asked for only where the others' values make that true.
function fieldOf(spec) {
  const id = `field-${spec.name}`;
  const hint = spec.hint ? el("small", { id: `${id}-hint` }, spec.hint) : null;
  const common = { id, name: spec.name, "aria-describedby": hint ? `${id}-hint` : null };
  if (spec.type === "checkbox") {
    return el(
      "div",
      { class: "field" },
      el("label", { class: "check" }, el("input", { ...common, type: "checkbox", checked: spec.value }), spec.label),
      hint,
    );
  }
  if (spec.type === "select") {
    const chosen = JSON.stringify(spec.value);
    const options = spec.options.map((option) =>
      el("option", { selected: JSON.stringify(option.value) === chosen }, option.text),
    );
    return el("div", { class: "field" }, el("label", { for: id }, spec.label), el("select", common, ...options), hint);
  }
  const input =
    spec.type === "textarea"
      ? el("textarea", { ...common, rows: 4, maxlength: spec.max })
      : el("input", {
          ...common,
          type: spec.type,
          min: spec.min,
          max: spec.type === "number" ? spec.max : null,
          step: spec.type === "number" ? (spec.step ?? 1) : null,
          required: spec.type === "number",
          maxlength: spec.type === "text" ? spec.max : null,
          autocomplete: "off",
        });
  input.value = spec.value ?? "";
  // A number that is typed replaces the one that stands there, which would else become a part of it.
  if (spec.type === "number") input.addEventListener("focus", () => input.select());
  return el("div", { class: "field" }, el("label", { for: id }, spec.label), input, hint);
}

function valuesOf(form, fields) {
  return Object.fromEntries(
    fields.map((spec) => {
      const input = form.elements[spec.name];
      if (spec.type === "checkbox") return [spec.name, input.checked];
      if (spec.type === "select") return [spec.name, spec.options[input.selectedIndex].value];
      return [spec.name, spec.type === "number" ? Number(input.value) : input.value];
    }),
  );
}

// Show a dialog; `act(values)` does what it asks for, and what it throws is shown in the dialog, which stays open.
// `tell(values)` says what would come of them, as they are typed.
export function askInDialog({ title, text, fields = [], label, isDangerous = false, tell = null, act }) {
  const told = tell ? el("p", { class: "told", role: "status" }) : null;
  const problem = el("div", { class: "problem", role: "alert" });
  const submit = el("button", { type: "submit", class: isDangerous ? "danger" : "primary" }, label);
  const cancel = el("button", { type: "button" }, "Cancel");
  const heading = el("h2", { id: "dialog-title" }, title);
  const rows = fields.map(fieldOf);
  const form = el(
    "form",
    { method: "dialog" },
    heading,
    text ? el("p", { class: "quiet" }, text) : null,
    ...rows,
    told,
    problem,
    el("div", { class: "buttons" }, cancel, submit),
  );
  const dialog = el("dialog", { class: "dialog", "aria-labelledby": "dialog-title" }, form);
  cancel.addEventListener("click", () => dialog.close());
  // Who goes back has left what it was about.
  const left = () => dialog.close();
  addEventListener("hashchange", left);
  dialog.addEventListener("close", () => {
    removeEventListener("hashchange", left);
    dialog.remove();
  });
  // Who selects a text in it and lets go outside has clicked on the dialog, too.
  let beganOutside = false;
  dialog.addEventListener("pointerdown", (event) => {
    beganOutside = event.target === dialog;
  });
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog && beganOutside) dialog.close();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    submit.disabled = true;
    problem.replaceChildren();
    try {
      await act(valuesOf(form, fields));
      dialog.close();
    } catch (error) {
      problem.replaceChildren(...refusal(error));
    } finally {
      submit.disabled = false;
    }
  });
  const showActing = () => {
    const values = valuesOf(form, fields);
    fields.forEach((spec, index) => {
      if (!spec.acts) return;
      const isIdle = !spec.acts(values);
      rows[index].hidden = isIdle;
      // A field that nobody sees must not keep the form from being sent.
      form.elements[spec.name].disabled = isIdle;
    });
  };
  for (const event of ["input", "change"]) form.addEventListener(event, showActing);
  showActing();
  const retell = () => setText(told, form.checkValidity() ? tell(valuesOf(form, fields)) : "");
  if (tell) form.addEventListener("input", retell);
  document.body.append(dialog);
  dialog.showModal();
  if (tell) retell();
  // A dangerous one begins where nothing happens.
  (form.querySelector("input, select, textarea") ?? (isDangerous ? cancel : submit)).focus();
  return dialog;
}

// What was refused, and what to do, as paragraphs.
export function refusal(error) {
  const lines = [el("p", {}, error.message)];
  if (error.hint) lines.push(el("p", { class: "quiet" }, error.hint));
  return lines;
}

export const GOES_ON = "The page goes on by itself once it is there.";

// What is asked for again and again until the service has it.
export function awaited(error) {
  const again = error.status >= 500 ? [el("p", { class: "quiet" }, GOES_ON)] : [];
  return [...refusal(error), ...again];
}

// The same, in a box that stands where it would be.
export const notYet = (error) => el("div", { class: "notice bad" }, awaited(error));

// A place for what was refused outside of a dialog; it stays until it is closed.
export function makeAlert() {
  const text = el("div", {});
  const close = el("button", { type: "button", class: "plain", "aria-label": "Close the message" }, "Close");
  const box = el("div", { class: "notice bad closable", hidden: true }, text, close);
  const place = el("div", { role: "alert" }, box);
  close.addEventListener("click", () => {
    box.hidden = true;
  });
  return {
    node: place,
    show(error) {
      text.replaceChildren(...refusal(error));
      box.hidden = false;
    },
    hide() {
      box.hidden = true;
      setText(text, "");
    },
  };
}
