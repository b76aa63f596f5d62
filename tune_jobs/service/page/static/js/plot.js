// A plot: uPlot has the axes, the grid, the zoom and the cursor; what is in it is drawn by the chart.
import { colour, el, onThemeChange } from "./dom.js";
import { tickTexts } from "./format.js";

const { uPlot } = window;
export const FONT_FAMILY = 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "Liberation Sans", sans-serif';
const FONT = `12px ${FONT_FAMILY}`;

// What has more digits than usual needs more room than usual.
const roomFor = (texts) => 10 + 7 * Math.max(0, ...texts.map((text) => text.length));

export class Plot {
  // `paint(context, places)` draws; `find(places, left, top)` returns what is near the cursor as { lines, id }, or null;
  // `yLabel` names what is plotted; `axes` are options of uPlot for the horizontal and the vertical axis, where they are others than those of numbers.
  constructor(host, { label, xLabel, yLabel = null, height, paint, find, onPick, axes = [] }) {
    this.range = { x: [0, 1], y: [0, 1] };
    this.isZoomed = false;
    this.found = null;
    this.chart = { paint, find, onPick };
    this.tip = el("div", { class: "tip", hidden: true });
    this.reset = el(
      "button",
      { type: "button", class: "reset", hidden: true, onclick: () => this.unzoom() },
      "Show all",
    );
    this.host = el("div", { class: "plot", role: "img", "aria-label": label });
    const box = el("div", { class: "plot-box" }, this.host, this.reset);
    box.style.minHeight = `${height}px`;
    host.append(box);
    const axis = {
      labelFont: FONT,
      stroke: () => colour("soft"),
      font: FONT,
      ticks: { show: false },
      grid: { stroke: () => colour("grid"), width: 1 },
    };
    const range = (_, min, max) => [min, max];
    this.u = new uPlot(
      {
        width: Math.max(50, box.clientWidth),
        height,
        legend: { show: false },
        // Half a label of the last tick is beside the plot.
        padding: [10, 20, 0, 0],
        scales: { x: { time: false, auto: false, range }, y: { auto: false, range } },
        axes: [
          {
            ...axis,
            label: xLabel,
            labelSize: 20,
            size: 30,
            gap: 4,
            space: 70,
            values: (_, values) => tickTexts(values),
            ...axes[0],
          },
          {
            ...axis,
            ...(yLabel ? { label: yLabel, labelSize: 18 } : {}),
            size: (_, texts) => Math.max(yLabel ? 44 : 52, roomFor(texts ?? [])),
            gap: 6,
            space: 34,
            values: (_, values) => tickTexts(values),
            ...axes[1],
          },
        ],
        series: [{}, { show: true, paths: () => null, points: { show: false } }],
        cursor: {
          points: { show: false },
          y: false,
          drag: { x: true, y: false, dist: 6 },
          bind: { dblclick: () => () => this.unzoom() },
        },
        hooks: {
          draw: [(u) => this.paint(u)],
          setCursor: [(u) => this.moved(u)],
          setSelect: [(u) => this.selected(u)],
        },
      },
      [
        [0, 1],
        [null, null],
      ],
      this.host,
    );
    this.u.over.append(this.tip);
    this.u.over.addEventListener("click", () => {
      if (this.found?.id) this.chart.onPick?.(this.found.id);
    });
    this.u.over.addEventListener("pointerleave", () => this.moved(null));
    this.watch = new ResizeObserver(() => {
      if (box.clientWidth > 0) this.u.setSize({ width: box.clientWidth, height: Math.max(height, box.clientHeight) });
    });
    this.watch.observe(box);
    this.forgetTheme = onThemeChange(() => this.u.redraw(false, true));
    this.setRange(this.range);
  }

  // Show these ranges, unless the reader has zoomed in.
  setRange(range) {
    this.range = { x: drawable(range.x), y: drawable(range.y) };
    if (this.isZoomed) this.u.redraw(false, false);
    else this.apply();
  }

  apply() {
    this.u.batch(() => {
      this.u.setScale("x", { min: this.range.x[0], max: this.range.x[1] });
      this.u.setScale("y", { min: this.range.y[0], max: this.range.y[1] });
    });
    this.u.redraw(false, true);
  }

  selected(u) {
    this.isZoomed = u.select.width > 0;
    this.reset.hidden = !this.isZoomed;
  }

  unzoom() {
    this.isZoomed = false;
    this.reset.hidden = true;
    this.apply();
  }

  places(u, ratio = devicePixelRatio) {
    const { left, top, width, height } = u.bbox;
    const { x, y } = u.scales;
    const perX = width / (x.max - x.min || 1);
    const perY = height / (y.max - y.min || 1);
    return {
      left,
      top,
      width,
      height,
      ratio,
      min: x.min,
      max: x.max,
      x: (value) => left + (value - x.min) * perX,
      y: (value) => top + height - (value - y.min) * perY,
    };
  }

  paint(u) {
    const context = u.ctx;
    const places = this.places(u);
    context.save();
    context.beginPath();
    context.rect(places.left, places.top - 2, places.width + 2, places.height + 4);
    context.clip();
    context.lineJoin = "round";
    this.chart.paint(context, places);
    context.restore();
  }

  moved(u) {
    const isInside = u !== null && u.cursor.left >= 0;
    const places = isInside ? this.places(u) : null;
    const found = isInside
      ? this.chart.find(places, places.left + u.cursor.left * places.ratio, places.top + u.cursor.top * places.ratio)
      : null;
    const changed = (found?.key ?? found?.id) !== (this.found?.key ?? this.found?.id);
    this.found = found;
    this.u?.over.classList.toggle("can-pick", Boolean(found?.id && this.chart.onPick));
    this.tip.hidden = found === null;
    if (found) {
      this.tip.replaceChildren(...found.lines.map((line, index) => el(index ? "span" : "b", {}, line)));
      const left = u.cursor.left;
      const isRight = left > u.over.clientWidth / 2;
      this.tip.style.left = isRight ? "auto" : `${left + 14}px`;
      this.tip.style.right = isRight ? `${u.over.clientWidth - left + 14}px` : "auto";
      this.tip.style.top = `${Math.max(0, Math.min(u.cursor.top - 20, u.over.clientHeight - this.tip.offsetHeight))}px`;
    }
    if (changed) this.u?.redraw(false, false);
  }

  redraw() {
    this.u.redraw(false, false);
  }

  describe(text) {
    this.host.setAttribute("aria-label", text);
  }

  close() {
    this.watch.disconnect();
    this.forgetTheme();
    this.u.destroy();
  }
}

// Ticks are looked for by adding: a range that is tiny beside its values, or beyond all numbers, would have no end of them.
const MOST = 1e300;
const LEAST_SHARE = 1e-9;

function drawable(range) {
  const [low, high] = range.map((value) => Math.max(-MOST, Math.min(MOST, value)));
  const least = LEAST_SHARE * Math.max(Math.abs(low), Math.abs(high)) || Number.EPSILON;
  return high - low > least ? [low, high] : [low - least, high + least];
}

// A range with some air, also around a single value.
export function withAir(low, high) {
  if (!(high > low)) {
    const air = Math.abs(low) * 0.05 || 1;
    return [low - air, low + air];
  }
  const air = 0.05 * (high - low);
  return [low - air, high + air];
}
