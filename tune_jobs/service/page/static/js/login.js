// The form that asks for a token, shown when the service wants to know who looks.
import { ask } from "./api.js";
import { el, setText } from "./dom.js";

export function openLogin(main, onDone) {
  const problem = el("p", { class: "problem", role: "alert" });
  const field = el("input", {
    type: "password",
    id: "token",
    name: "token",
    autocomplete: "current-password",
    required: true,
    spellcheck: "false",
  });
  const button = el("button", { class: "primary", type: "submit" }, "Log in");
  const form = el(
    "form",
    { class: "card login" },
    el("h1", {}, "Log in"),
    el("p", { class: "quiet" }, "This service wants a token. Whoever runs it gives you one."),
    // Password managers keep a token by the name that stands here.
    el("input", { type: "text", name: "username", autocomplete: "username", value: "tune-jobs", hidden: true }),
    el("label", { for: "token" }, "Token"),
    field,
    problem,
    button,
  );
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    setText(problem, "");
    try {
      await ask("login", { method: "POST", body: { token: field.value.trim() } });
      onDone();
    } catch (error) {
      setText(problem, [error.message, error.hint].filter(Boolean).join(" "));
      field.select();
    } finally {
      button.disabled = false;
    }
  });
  document.title = "Log in · tune-jobs";
  main.replaceChildren(form);
  field.focus();
}
