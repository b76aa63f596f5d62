// The table of trials. Only the rows in sight are in the page, so that 10,000 of them sort and scroll without a wait.
import { el, reconcile, setAttribute, setText } from "./dom.js";
import { count, counted } from "./format.js";
import { trialTone } from "./states.js";

const ROW_PX = 32;
const SPARE_ROWS = 8;

export class TrialTable {
  // `onSort(key)`, `onOpen(trialId)`, `onChoose(trialId)` and `onHover(trialId | null)` are called for what the reader does.
  constructor(host, { onSort, onOpen, onChoose, onHover }) {
    this.act = { onSort, onOpen, onChoose, onHover };
    this.rows = [];
    this.columns = [];
    this.chosen = new Map();
    this.opened = null;
    this.focused = 0;
    this.head = el("tr", { "aria-rowindex": 1 });
    this.above = el("tr", { class: "space", "aria-hidden": "true" }, el("td"));
    this.below = el("tr", { class: "space", "aria-hidden": "true" }, el("td"));
    this.body = el("tbody");
    this.table = el(
      "table",
      { class: "trials" },
      el("caption", { class: "for-readers" }, "Trials: Enter opens one, Space chooses it for the charts"),
      el("thead", {}, this.head),
      el("tbody", { "aria-hidden": "true" }, this.above),
      this.body,
      el("tbody", { "aria-hidden": "true" }, this.below),
    );
    const region = { class: "scroller", role: "region", "aria-label": "Table of trials", tabindex: -1 };
    this.scroller = el("div", region, this.table);
    this.told = el("p", { class: "quiet small", role: "status" });
    this.none = el("p", { class: "empty quiet", hidden: true }, "No trial matches.");
    host.append(this.scroller, this.none);
    this.scroller.addEventListener("scroll", () => this.draw(), { passive: true });
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(this.scroller);
    this.body.addEventListener("click", (event) => this.clicked(event));
    this.body.addEventListener("keydown", (event) => this.pressed(event));
    this.body.addEventListener("focusin", (event) => this.noteFocus(event));
    this.body.addEventListener("pointerover", (event) => onHover(event.target.closest("tr")?.dataset.key ?? null));
    this.body.addEventListener("pointerleave", () => onHover(null));
  }

  // `chosen` is a Map of trial ids to colours.
  show({ rows, numAll, columns, sort, isRising, chosen, opened }) {
    Object.assign(this, { rows, chosen, opened });
    if (columns !== this.columns) this.setColumns(columns);
    for (const head of this.head.children) {
      setAttribute(head, "aria-sort", head.dataset.column === sort ? (isRising ? "ascending" : "descending") : null);
    }
    setAttribute(this.table, "aria-rowcount", rows.length + 1);
    setText(
      this.told,
      rows.length === numAll ? counted(numAll, "trial") : `${count(rows.length)} of ${counted(numAll, "trial")}`,
    );
    this.focused = Math.min(this.focused, Math.max(0, rows.length - 1));
    this.none.hidden = rows.length > 0;
    this.scroller.hidden = rows.length === 0;
    this.draw();
  }

  setColumns(columns) {
    this.columns = columns;
    this.body.replaceChildren();
    this.head.replaceChildren(
      el("th", { scope: "col", class: "choose" }, el("span", { class: "for-readers" }, "Chosen")),
      ...columns.map((column) =>
        el(
          "th",
          { scope: "col", class: column.isNumber ? "number" : null, dataset: { column: column.key } },
          el("button", { type: "button", onclick: () => this.act.onSort(column.key) }, column.label),
        ),
      ),
    );
    for (const space of [this.above, this.below]) space.firstElementChild.colSpan = columns.length + 1;
  }

  draw() {
    const { scrollTop, clientHeight } = this.scroller;
    const first = Math.max(0, Math.floor(scrollTop / ROW_PX) - SPARE_ROWS);
    const last = Math.min(this.rows.length, Math.ceil((scrollTop + clientHeight) / ROW_PX) + SPARE_ROWS);
    this.above.style.height = `${first * ROW_PX}px`;
    this.below.style.height = `${Math.max(0, this.rows.length - last) * ROW_PX}px`;
    const inSight = this.rows.slice(first, last).map((row, offset) => ({ row, place: first + offset }));
    // The row that has the focus stays, wherever the table is scrolled to: the focus would fall to the page.
    const focusedRow = this.body.contains(document.activeElement) ? document.activeElement.closest("tr") : null;
    const focusedKey = focusedRow?.dataset.key;
    reconcile(
      this.body,
      inSight,
      (item) => item.row.trial_id,
      () => this.makeRow(),
      (node, item) => this.updateRow(node, item),
    );
    if (focusedKey !== undefined && document.activeElement === document.body)
      this.scroller.focus({ preventScroll: true });
  }

  makeRow() {
    return el(
      "tr",
      {},
      el("td", { class: "choose" }, el("input", { type: "checkbox", tabindex: -1 })),
      ...this.columns.map((column, index) =>
        index === 0 ? el("th", { scope: "row" }) : el("td", { class: column.isNumber ? "number" : null }),
      ),
    );
  }

  updateRow(node, { row, place }) {
    setAttribute(node, "aria-rowindex", place + 2);
    setAttribute(node, "tabindex", place === this.focused ? 0 : -1);
    setAttribute(
      node,
      "class",
      [row.trial_id === this.opened ? "opened" : "", this.chosen.has(row.trial_id) ? "chosen" : ""].join(" ").trim() ||
        null,
    );
    const box = node.firstElementChild.firstElementChild;
    box.checked = this.chosen.has(row.trial_id);
    setAttribute(box, "aria-label", `Choose ${row.trial_id} for the charts`);
    box.style.accentColor = this.chosen.get(row.trial_id) ?? "";
    this.columns.forEach((column, index) => {
      const cell = node.children[index + 1];
      setText(cell, column.text(row));
      if (column.key === "status") setAttribute(cell, "class", `status ${trialTone(row.status)}`);
    });
  }

  idOf(event) {
    return event.target.closest("tr")?.dataset.key;
  }

  clicked(event) {
    const id = this.idOf(event);
    if (!id) return;
    this.focus(this.rows.findIndex((row) => row.trial_id === id));
    if (event.target.closest(".choose")) {
      // The table itself says what is chosen.
      event.preventDefault();
      setTimeout(() => this.act.onChoose(id));
    } else if (!getSelection().toString()) this.act.onOpen(id);
  }

  noteFocus(event) {
    const place = this.rows.findIndex((row) => row.trial_id === this.idOf(event));
    if (place >= 0 && place !== this.focused) {
      this.focused = place;
      this.draw();
    }
  }

  focus(place) {
    if (!this.rows.length) return;
    this.focused = Math.max(0, Math.min(this.rows.length - 1, place));
    const top = this.focused * ROW_PX;
    const room = this.scroller.clientHeight - this.head.offsetHeight;
    if (top < this.scroller.scrollTop) this.scroller.scrollTop = top;
    else if (top + ROW_PX > this.scroller.scrollTop + room) this.scroller.scrollTop = top + ROW_PX - room;
    this.draw();
    this.body.querySelector('tr[tabindex="0"]')?.focus({ preventScroll: true });
  }

  pressed(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const page = Math.max(1, Math.floor(this.scroller.clientHeight / ROW_PX) - 2);
    const places = {
      ArrowDown: this.focused + 1,
      ArrowUp: this.focused - 1,
      PageDown: this.focused + page,
      PageUp: this.focused - page,
      Home: 0,
      End: this.rows.length - 1,
    };
    const id = this.idOf(event);
    if (event.key in places) this.focus(places[event.key]);
    else if (event.key === "Enter" && id) this.act.onOpen(id);
    else if (event.key === " " && id) this.act.onChoose(id);
    else return;
    event.preventDefault();
  }

  close() {
    this.watch.disconnect();
  }
}
