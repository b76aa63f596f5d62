// What is drawn of an axis of parallel coordinates over its lines: title, ticks, and the range with its two ends.
import { setAttribute, setText, svg } from "./dom.js";
import { settingText } from "./format.js";

export const HEIGHT = 300;
export const SIDE = 56;
const TOP = 34;
const BOTTOM = 16;

export const topOf = (at) => TOP + (1 - at) * (HEIGHT - TOP - BOTTOM);
export const placeAt = (top) => Math.max(0, Math.min(1, 1 - (top - TOP) / (HEIGHT - TOP - BOTTOM)));

// `onKey(event, name, end)` is called for keys on an end of the range, which is "low" or "high".
export function makeMarks(name, onKey) {
  const handle = (end) =>
    svg("rect", {
      class: "handle",
      tabindex: 0,
      role: "slider",
      "aria-orientation": "vertical",
      "aria-label": `${end === "low" ? "Lower" : "Upper"} end of ${name}`,
      "aria-valuemin": 0,
      "aria-valuemax": 100,
      x: -9,
      width: 18,
      height: 6,
      rx: 3,
      dataset: { axis: name, end },
      onkeydown: (event) => onKey(event, name, end),
    });
  const room = { y: TOP - 10, height: HEIGHT - TOP - BOTTOM + 20 };
  return svg(
    "g",
    { dataset: { axis: name } },
    svg("text", { class: "title", y: 14 }),
    svg("line", { class: "axis", y1: topOf(1), y2: topOf(0) }),
    svg("g", { class: "ticks" }),
    svg("rect", { class: "range", x: -9, width: 18, rx: 4, y: 0, height: 0 }),
    svg("rect", { class: "grip", x: -20, width: 40, ...room, dataset: { axis: name } }),
    handle("low"),
    handle("high"),
  );
}

// Put the marks where their axis is; `side` is "first", "last" or "middle".
export function placeMarks(group, axis, side) {
  setAttribute(group, "transform", `translate(${axis.left} 0)`);
  const title = group.querySelector(".title");
  setAttribute(title, "text-anchor", { first: "start", last: "end", middle: "middle" }[side]);
  setAttribute(title, "dx", { first: 8 - SIDE, last: SIDE - 8, middle: 0 }[side]);
  setText(title, axis.kind === "log" ? `${axis.name} (log)` : axis.name);
  const ticks = group.querySelector(".ticks");
  const shape = JSON.stringify([axis.ticks, side === "last"]);
  if (ticks.dataset.shape === shape) return;
  ticks.dataset.shape = shape;
  const text =
    side === "last" ? { class: "halo", x: 9, "text-anchor": "start" } : { class: "halo", x: -8, "text-anchor": "end" };
  ticks.replaceChildren(
    ...axis.ticks.map((tick) =>
      svg(
        "g",
        { class: "tick", transform: `translate(0 ${topOf(tick.at)})` },
        svg("line", { x1: -4, x2: 0 }),
        svg("text", { ...text, dy: "0.32em" }, tick.text),
      ),
    ),
  );
}

// Show a range, places on the axis.
export function showRange(group, axis, [low, high], isSet) {
  const area = group.querySelector(".range");
  setAttribute(area, "y", topOf(high));
  setAttribute(area, "height", Math.max(2, topOf(low) - topOf(high)));
  group.classList.toggle("set", isSet);
  for (const handle of group.querySelectorAll(".handle")) {
    const at = handle.dataset.end === "low" ? low : high;
    setAttribute(handle, "y", topOf(at) - 3);
    setAttribute(handle, "aria-valuenow", Math.round(100 * at));
    setAttribute(handle, "aria-valuetext", valueText(axis, at));
  }
}

function valueText(axis, at) {
  if (axis.valueAt) return settingText(axis.valueAt(at), 3);
  const half = 0.5 / axis.texts.length;
  return axis.rangeText(at - half, at + half) || "none";
}
