// The editor of a sweep file: a text area with line numbers, colours, marks at what is wrong, and completion.
import { el, reconcile, setAttribute, speak } from "./dom.js";

const LINE_PX = 21;
const PAD_PX = 12;
const LEAST_LINES = 24;
const TOKEN = /(#.*$)|("[^"]*"|'[^']*')|(-?\b\d[\d_]*(?:\.\d+)?(?:e[+-]?\d+)?\b)|\b(true|false|null|yes|no|on|off)\b/g;

export class Editor {
  constructor(host, { label, onChange }) {
    this.onChange = onChange;
    this.completion = null;
    this.offer = null;
    this.marks = new Map();
    this.area = el("textarea", {
      class: "code",
      id: "sweep-file",
      "aria-label": label,
      "aria-autocomplete": "list",
      "aria-describedby": "editor-help",
      wrap: "off",
      spellcheck: "false",
      autocomplete: "off",
      autocapitalize: "off",
    });
    this.numbers = el("div", { class: "numbers", "aria-hidden": "true" });
    this.backdrop = el("pre", { class: "code backdrop", "aria-hidden": "true" });
    this.list = el("ul", { class: "offers", role: "listbox", id: "offers", "aria-label": "Completions", hidden: true });
    const sheet = el("div", { class: "sheet" }, this.backdrop, this.area, this.list);
    host.append(
      el("div", { class: "editor" }, this.numbers, sheet),
      el(
        "p",
        { class: "quiet small", id: "editor-help" },
        "Completions show as you type, or with Ctrl+Space; Enter takes one, Escape closes them. Tab leaves the editor.",
      ),
    );
    this.area.addEventListener("input", () => this.changed());
    this.area.addEventListener("scroll", () => {
      this.backdrop.scrollLeft = this.area.scrollLeft;
    });
    this.area.addEventListener("keydown", (event) => this.pressed(event));
    this.area.addEventListener("blur", () => this.close());
    this.area.addEventListener("click", () => this.close());
    this.draw();
  }

  get text() {
    return this.area.value;
  }

  set text(value) {
    this.area.value = value;
    this.close();
    this.draw();
  }

  changed() {
    this.draw();
    this.suggest(false);
    this.onChange();
  }

  draw() {
    const lines = this.text.split("\n");
    const height = `${Math.max(lines.length, LEAST_LINES) * LINE_PX + 2 * PAD_PX}px`;
    this.area.style.height = this.backdrop.style.height = height;
    reconcile(
      this.numbers,
      lines.map((_, index) => index),
      (index) => index,
      (index) => el("span", {}, String(index + 1)),
      (node, index) => {
        setAttribute(node, "class", this.marks.has(index) ? "bad" : null);
        setAttribute(node, "title", this.marks.get(index) ?? null);
      },
    );
    this.backdrop.replaceChildren(
      ...lines.map((line, index) =>
        el("span", { class: this.marks.has(index) ? "line bad" : "line" }, ...coloured(line)),
      ),
    );
  }

  // Mark lines: a Map of line (0 is the first) to what is wrong there.
  mark(marks) {
    this.marks = marks;
    this.draw();
  }

  goTo(line) {
    const lines = this.text.split("\n");
    const start = lines.slice(0, line).reduce((sum, content) => sum + content.length + 1, 0);
    this.area.focus();
    this.area.setSelectionRange(start, start + (lines[line] ?? "").length);
    this.numbers.children[line]?.scrollIntoView({ block: "center" });
  }

  suggest(isAsked) {
    const { selectionStart: position, selectionEnd } = this.area;
    const found = position === selectionEnd && this.completion ? this.completion.at(this.text, position) : null;
    // Nobody is told all keys at the begin of each empty line.
    const isBegun = found && (isAsked || found.from < position || /:\s+$/.test(this.text.slice(0, position)));
    if (!isBegun) {
      this.close();
      if (isAsked) speak("No completions here.");
      return;
    }
    const wasOpen = this.offer !== null;
    this.offer = { ...found, chosen: 0, position };
    this.showOffers();
    if (!wasOpen) speak(`${found.items.length} completions.`);
  }

  showOffers() {
    const { items, chosen, from } = this.offer;
    this.list.replaceChildren(
      ...items.map((item, index) =>
        el(
          "li",
          {
            role: "option",
            id: `offer-${index}`,
            "aria-selected": String(index === chosen),
            onpointerdown: (event) => {
              event.preventDefault();
              this.take(index);
            },
          },
          el("b", {}, item.text),
          item.about ? el("span", {}, item.about) : null,
        ),
      ),
    );
    this.list.hidden = false;
    setAttribute(this.area, "aria-controls", "offers");
    setAttribute(this.area, "aria-activedescendant", `offer-${chosen}`);
    const before = this.text.slice(0, from);
    const line = before.split("\n").length - 1;
    const column = from - (before.lastIndexOf("\n") + 1);
    this.list.style.top = `${PAD_PX + (line + 1) * LINE_PX + 2}px`;
    this.list.style.left = `calc(${PAD_PX - this.area.scrollLeft}px + ${column}ch)`;
    this.list.children[chosen].scrollIntoView({ block: "nearest" });
  }

  close() {
    this.offer = null;
    this.list.hidden = true;
    setAttribute(this.area, "aria-activedescendant", null);
    setAttribute(this.area, "aria-controls", null);
  }

  take(index) {
    const { items, from, position } = this.offer;
    const item = items[index];
    this.insert(item.insert, from, position);
    if (item.back)
      this.area.setSelectionRange(this.area.selectionStart - item.back, this.area.selectionStart - item.back);
    this.close();
  }

  // As if it were typed, so that the browser can undo it.
  insert(text, from, to) {
    this.area.focus();
    this.area.setSelectionRange(from, to);
    if (!document.execCommand("insertText", false, text)) {
      this.area.setRangeText(text, from, to, "end");
      this.changed();
    }
  }

  pressed(event) {
    if (event.key === " " && event.ctrlKey) this.suggest(true);
    else if (this.offer && ["ArrowDown", "ArrowUp"].includes(event.key)) {
      const { length } = this.offer.items;
      this.offer.chosen = (this.offer.chosen + (event.key === "ArrowDown" ? 1 : length - 1)) % length;
      this.showOffers();
    } else if (this.offer && event.key === "Enter") this.take(this.offer.chosen);
    else if (this.offer && event.key === "Escape") this.close();
    else if (this.offer && ["ArrowLeft", "ArrowRight", "Home", "End"].includes(event.key)) {
      this.close();
      return;
    } else if (event.key === "Enter" && !event.ctrlKey && !event.metaKey) this.newLine();
    else return;
    event.preventDefault();
  }

  // A new line begins where the one before did, deeper after a key that opens a mapping.
  newLine() {
    const { selectionStart: position, selectionEnd } = this.area;
    const line = this.text.slice(this.text.lastIndexOf("\n", position - 1) + 1, position);
    const indent = /^\s*/.exec(line)[0] + (/:\s*$/.test(line) ? "  " : "");
    this.insert(`\n${indent}`, position, selectionEnd);
  }
}

// A line as pieces with classes; the text area over it has the same text, without a colour.
function coloured(line) {
  const pieces = [];
  const key = /^(\s*(?:-\s+)?)([A-Za-z_][\w.-]*)(?=\s*:(?:\s|$))/.exec(line);
  let at = 0;
  if (key) {
    pieces.push(key[1], el("i", { class: "key" }, key[2]));
    at = key[0].length;
  }
  for (const match of line.slice(at).matchAll(TOKEN)) {
    const start = at + match.index;
    pieces.push(
      line.slice(pieces.end ?? at, start),
      el("i", { class: match[1] ? "comment" : match[2] ? "text" : "number" }, match[0]),
    );
    pieces.end = start + match[0].length;
  }
  pieces.push(line.slice(pieces.end ?? at));
  return pieces;
}

export const lineText = (line) => (line === null ? "" : `Line ${line + 1}`);
