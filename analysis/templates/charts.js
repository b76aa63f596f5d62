// Draws the page's charts from their data (see analysis/charts/model.py) with Apache ECharts. A plot is drawn once it comes
// near the view, so that a long page opens at once; again when the theme or the width changes; and for paper, in light.
(() => {
  const source = document.getElementById("chart-data");
  if (!source) return;
  const { charts, trials, colors } = JSON.parse(source.textContent);
  const darkTheme = matchMedia("(prefers-color-scheme: dark)");
  const PAPER_WIDTH = 660, NARROW = 560, MAX_LABELS = 12, NUM_COLORS = 6;
  let onPaper = false;

  const color = (name) => colors[darkTheme.matches && !onPaper ? "dark" : "light"]["--" + name];
  const ramp = () => [0, 1, 2, 3, 4].map((i) => color("ramp-" + i));
  const category = (i) => color(i < NUM_COLORS ? "series-" + i : "muted");
  const known = (values) => values.filter((value) => value !== null);
  const rounded = (value, digits) => (Math.abs(value) >= 1e6 || (value && Math.abs(value) < 1e-3)
    ? value.toExponential(digits - 2).replace(/\.?0+e/, "e").replace("e+", "e") : String(+value.toPrecision(digits)));
  const short = (value) => rounded(value, 4);
  // As many digits as tell the ticks of an axis apart; where its ends are not given, they are round numbers themselves.
  const ticks = (axis) => {
    const [low, high] = [axis.low, axis.high], size = Math.max(Math.abs(low), Math.abs(high));
    const digits = low < high ? Math.min(12, Math.max(4, 3 + Math.ceil(Math.log10(size / (high - low))))) : 8;
    return (value) => rounded(value, digits);
  };
  const steps = (value) => {
    const [size, letter] = value >= 1e9 ? [1e9, "G"] : value >= 1e6 ? [1e6, "M"] : value >= 1e3 ? [1e3, "k"] : [1, ""];
    return +(value / size).toPrecision(4) + letter;
  };
  // Whole numbers with all of their digits, as in the tables: a batch of 65,536 is not one of 65,540.
  const exact = (value) => (Number.isInteger(value) && Math.abs(value) < 1e15 ? value.toLocaleString("en") : short(value));
  const said = (axis, value) => (axis.kind === "category" ? axis.labels[value]
    : exact(/env steps/.test(axis.name) ? Math.round(value) : value));

  // What a part of the page is made of; texts are never read as HTML.
  function element(name, className, ...content) {
    const made = document.createElement(name);
    made.className = className;
    made.append(...content);
    return made;
  }
  const tip = (lines) => element("div", "tip", ...lines.map((line) => element("div", "", line)));

  // ---- Axes and frames

  function axisOption(axis, vertical, narrow) {
    const option = {
      type: axis.kind === "log" ? "log" : "value", scale: true, min: axis.low, max: axis.high,
      name: axis.name, nameLocation: vertical ? "end" : "middle", nameGap: vertical ? 12 : 26,
      nameTextStyle: { color: color("ink"), align: vertical ? "left" : "center" },
      axisLabel: { color: color("ink"), hideOverlap: true, formatter: /env steps/.test(axis.name) ? steps : ticks(axis) },
      axisLine: { show: !vertical, onZero: false, lineStyle: { color: color("muted") } }, axisTick: { show: false },
      splitLine: { lineStyle: { color: color("grid") } }, splitNumber: narrow ? 3 : 5,
    };
    if (axis.kind !== "category") return option;
    const places = axis.labels.map((_, i) => i), isRange = axis.labels.some((label) => label.includes(" to "));
    const label = (i) => (isRange && !vertical && !narrow ? axis.labels[i]?.replace(" to ", "\nto ") : axis.labels[i]) ?? "";
    return { ...option, min: -0.5, max: axis.labels.length - 0.5, splitLine: { show: false }, axisLabel: {
      ...option.axisLabel, customValues: places, formatter: label, width: narrow && !isRange ? 80 : 130,
      overflow: "truncate", interval: 0, lineHeight: 13, hideOverlap: places.length > MAX_LABELS,
      rotate: !vertical && isRange && narrow ? 70 : !vertical && !isRange && axis.labels.join("").length > (narrow ? 24 : 60) ? 30 : 0,
    } };
  }

  const frame = (x, y, narrow, more) => ({
    grid: { left: 8, right: 18, top: 8, bottom: 8, outerBoundsMode: "same", outerBoundsContain: "all" },
    xAxis: axisOption(x, false, narrow), yAxis: axisOption(y, true, narrow), ...more,
  });

  const goalLine = (goal) => ({
    silent: true, symbol: "none", data: [{ yAxis: goal }], lineStyle: { color: color("accent"), type: [6, 4], width: 1.5 },
    label: { formatter: "goal " + short(goal), color: color("accent"), position: "insideEndBottom" },
  });

  // ---- Trials: panels, and lines through all hyperparameters

  const extent = (values) => [Math.min(...known(values)), Math.max(...known(values))];
  function placeOn(axis, [low, high], value) {
    if (high <= low) return 0.5;
    return axis.kind === "log" ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
  }
  const alongRamp = (axis, ends, value) => echarts.color.lerp(placeOn(axis, ends, value), ramp());
  const jitter = (i) => 0.6 * (((i * 0.618034) % 1) - 0.5);
  const ENDINGS = { cut: "cut early by a scheduler", unfinished: "not ended yet", failed: "without a score" };

  function trialTip(i) {
    const score = trials.scores[i], ending = ENDINGS[trials.endings[i]];
    return tip([
      trials.ids[i] + (score === null ? "" : ": " + short(score)) + (ending ? ", " + ending : ""),
      ...trials.columns.filter((column) => column.values[i] !== null)
        .map((column) => column.axis.name + ": " + said(column.axis, column.values[i])),
    ]);
  }

  function trialColor(column) {
    const ends = extent(column.values);
    return (i) => (column.values[i] === null ? color("muted") : column.axis.kind === "category"
      ? category(column.values[i]) : alongRamp(column.axis, ends, column.values[i]));
  }

  const endingKeys = () => Object.keys(ENDINGS).filter((ending) => trials.endings.includes(ending))
    .map((ending) => ({ name: ENDINGS[ending], color: "muted", mark: ending === "failed" ? "cross" : "hollow" }));

  function panels() {
    const paint = trialColor(trials.columns[0]);
    const scores = extent(trials.scores), floor = scores[0] - 0.08 * (scores[1] - scores[0]);
    return trials.columns.map(({ axis, values }) => ({
      option: (narrow) => frame(axis, { ...trials.score, name: trials.score.name.split(",")[0] }, true, {
        tooltip: { formatter: (at) => trialTip(at.data.trial) },
        series: [{ type: "scatter", symbolSize: trials.shown.length > 200 ? 5 : 8, data: trials.shown
          .filter((i) => values[i] !== null).map((i) => {
            const ending = trials.endings[i], lost = ending === "failed", whole = ending === "whole";
            return {
              trial: i, value: [values[i] + (axis.kind === "category" ? jitter(i) : 0), lost ? floor : trials.scores[i]],
              symbol: lost ? "path://M0,1L1,0L5,4L9,0L10,1L6,5L10,9L9,10L5,6L1,10L0,9L4,5Z" : "circle",
              itemStyle: lost ? { color: color("muted") } : {
                color: whole ? paint(i) : "transparent", borderColor: paint(i), borderWidth: whole ? 0 : 1.5,
                opacity: 0.85,
              },
            };
          }) }],
      }),
    }));
  }

  function panelKeys() {
    const { axis, values } = trials.columns[0];
    if (axis.kind !== "category") return [{ name: axis.name, ramp: extent(values).map(short) }, ...endingKeys()];
    // Those beyond the colours look alike, so one key tells of them all.
    const others = axis.labels.length - NUM_COLORS;
    return [
      ...axis.labels.slice(0, NUM_COLORS).map((label, i) => ({ name: axis.name + " " + label, color: "series-" + i })),
      ...(others > 0 ? [{ name: exact(others) + " other value" + (others > 1 ? "s" : ""), color: "muted" }] : []),
      ...endingKeys(),
    ];
  }

  const halo = () => ({ textBorderColor: color("card"), textBorderWidth: 3 });

  // A trial's line in pieces: pale where it passes by the axes of what does not act in it.
  function pieces(columns, i) {
    const dims = columns.map((_, dim) => dim).filter((dim) => columns[dim].values[i] !== null);
    const runs = [[]];
    for (const dim of dims) (runs.at(-1).length && dim - runs.at(-1).at(-1) > 1 ? runs[runs.push([]) - 1] : runs.at(-1)).push(dim);
    const gaps = runs.slice(1).map((run, at) => [runs[at].at(-1), run[0]]);
    const of = (part) => columns.map((column, dim) => (part.includes(dim) ? column.values[i] : null));
    return [...gaps.map((part) => ({ value: of(part), isPale: true })),
      ...runs.filter((part) => part.length > 1).map((part) => ({ value: of(part), isPale: false }))];
  }

  function parallel(chart) {
    const columns = [...trials.columns, { axis: trials.score, values: trials.scores }];
    const ends = extent(trials.scores);
    const drawn = trials.shown.filter((i) => trials.scores[i] !== null)
      .sort((one, two) => trials.scores[one] - trials.scores[two]);
    const option = (narrow) => ({
      parallel: { layout: narrow ? "vertical" : "horizontal", left: narrow ? 30 : 50, right: narrow ? 30 : 60,
        top: narrow ? 30 : 40, bottom: 30 },
      parallelAxis: columns.map(({ axis, values }, dim) => ({
        dim, name: axis.name.split(",")[0], type: axis.kind === "category" ? "category" : axis.kind, data: axis.labels,
        nameTextStyle: { color: color("ink"), ...halo(), ...(narrow ? { align: "left", verticalAlign: "bottom", padding: [0, 0, 6, 0] } : {}) },
        nameLocation: narrow ? "start" : "end", nameGap: narrow ? 0 : 12,
        axisLabel: { color: color("ink"), ...halo(), width: 90, overflow: "truncate", hideOverlap: true,
          ...(axis.kind === "category" ? {} : { formatter: short }) },
        axisLine: { lineStyle: { color: color("muted") } }, axisTick: { lineStyle: { color: color("muted") } },
        ...(axis.kind === "category" ? {} : { scale: true, min: extent(values)[0], max: extent(values)[1] }),
        areaSelectStyle: { width: 18, borderColor: color("ink"), color: color("muted"), opacity: 0.35 },
      })),
      tooltip: { formatter: (at) => trialTip(at.data.trial) },
      series: [{ type: "parallel", inactiveOpacity: 0.04, activeOpacity: 0.9, data: drawn.flatMap((i) => pieces(columns, i).map((piece) => ({
        trial: i, value: piece.value,
        lineStyle: { color: alongRamp(trials.score, ends, trials.scores[i]), width: 1.4,
          opacity: piece.isPale ? 0.15 : drawn.length > 150 ? 0.4 : 0.7, type: trials.endings[i] === "whole" ? "solid" : "dashed" },
      }))) }],
    });
    const after = (drawing) => drawing.on("axisareaselected", () => {
      const ranges = drawing.getModel().queryComponents({ mainType: "parallelAxis" }).map((axis) => axis.activeIntervals);
      choose(chart, columns, ranges);
    });
    return [{ option, after, leastWidth: 95 * columns.length, height: (narrow) => (narrow ? 90 * columns.length : 380) }];
  }

  // The trials whose values are in the chosen ranges, as the event "trials-chosen" (null: no range is chosen).
  function choose(chart, columns, ranges) {
    const inside = (dim, i) => !ranges[dim].length
      || ranges[dim].some(([low, high]) => columns[dim].values[i] !== null
        && columns[dim].values[i] >= Math.min(low, high) && columns[dim].values[i] <= Math.max(low, high));
    const any = ranges.some((range) => range.length);
    const chosen = any ? trials.ids.filter((_, i) => columns.every((_, dim) => inside(dim, i))) : null;
    chart.said.textContent = any ? chosen.length + " of " + trials.ids.length + " trials are in the chosen ranges; "
      + "press an axis beside its range to let go of it." : "";
    document.dispatchEvent(new CustomEvent("trials-chosen", { detail: chosen && new Set(chosen) }));
  }

  const parallelKeys = () => [{ name: trials.score.name, ramp: extent(trials.scores).map(short) },
    ...endingKeys().filter((key) => key.mark !== "cross").map((key) => ({ ...key, mark: "dashed" }))];

  // ---- Lines, with bands

  const stepped = (points) => points.flatMap(([x, y], i) => (i ? [[x, points[i - 1][1]], [x, y]] : [[x, y]]));

  function lineSeries(line, plot) {
    const paint = color(line.color), look = line.look ?? "line";
    const values = line.x.map((x, i) => ({ value: [x, line.y[i]], text: line.texts?.[i] }));
    const shared = { name: line.name, itemStyle: { color: paint }, animation: false };
    if (look === "hollow" || look === "dots") {
      return [{ ...shared, type: "scatter", data: values, symbolSize: 6, z: 3, tooltip: { show: false }, itemStyle: {
        color: look === "hollow" ? "transparent" : paint, borderColor: paint, borderWidth: 1.5 } }];
    }
    const style = { line: { width: 2.2 }, thin: { width: 0.8, opacity: 0.5 }, pale: { width: 0.8, opacity: 0.4 } }[look];
    const series = [{ ...shared, type: "line", data: values, step: line.is_stepped ? "end" : false,
      lineStyle: { color: paint, ...style }, symbol: "circle", symbolSize: 5, z: look === "line" ? 3 : 2,
      showSymbol: values.length === 1, silent: look !== "line", tooltip: { show: look === "line" } }];
    if (line.lower) series.push(band(line, plot, paint));
    return series;
  }

  function band(line, plot, paint) {
    const edge = (values) => {
      const points = line.x.map((x, i) => [x, values[i]]);
      return line.is_stepped ? stepped(points) : points;
    };
    const around = [...edge(line.upper), ...edge(line.lower).reverse()];
    return {
      name: line.name, type: "custom", silent: true, clip: true, z: 1, tooltip: { show: false }, data: around,
      renderItem: (at, api) => (at.dataIndexInside ? undefined : { type: "polygon",
        shape: { points: around.map((point) => api.coord(point)) }, style: { fill: paint, opacity: 0.16 } }),
    };
  }

  function plotTip(plot) {
    return (found) => {
      const places = [found].flat().filter((at) => at.value[1] !== null);
      return places.length ? tip([
        plot.x.name + ": " + said(plot.x, places[0].value[0]),
        ...places.map((at) => at.seriesName + ": " + said(plot.y, at.value[1]) + (at.data.text ? " (" + at.data.text + ")" : "")),
      ]) : "";
    };
  }

  // The goal's line has a point that is not seen: axes reach to points, but not to marks.
  const goalSeries = ({ goal, lines }) => (goal === undefined ? [] : [{
    type: "line", data: [[known(lines.flatMap((line) => line.x))[0], goal]], symbol: "none", silent: true,
    tooltip: { show: false }, markLine: goalLine(goal),
  }]);

  const plots = (chart) => chart.plots.map((plot) => ({
    title: plot.title,
    option: (narrow) => frame(plot.x, plot.y, narrow || chart.plots.length > 1, {
      tooltip: { trigger: "axis", axisPointer: { lineStyle: { color: color("muted") } }, formatter: plotTip(plot) },
      series: plot.lines.filter((line) => !chart.hidden.has(line.name)).flatMap((line) => lineSeries(line, plot))
        .concat(goalSeries(plot)),
    }),
  }));

  const plotKeys = (chart) => [...new Map(chart.plots.flatMap((plot) => plot.lines).map((line) => [line.name, line])).values()]
    .map((line) => ({ name: line.name, color: line.color, mark: { hollow: "hollow", dots: "dot" }[line.look] ?? "line", toggles: true }));

  // ---- Heat map and timeline

  function heatMap(chart) {
    const cells = chart.cells, means = extent(cells.map((cell) => cell.mean));
    return [{ option: (narrow) => frame(chart.x, chart.y, narrow, {
      tooltip: { formatter: (at) => {
        const cell = cells[at.dataIndex];
        return tip([
          chart.x.name + ": " + said(chart.x, cell.x), chart.y.name + ": " + said(chart.y, cell.y),
          "mean score " + short(cell.mean) + ", best " + short(cell.best) + ", trials " + cell.count,
        ]);
      } },
      series: [{ type: "custom", data: cells.map((cell) => [cell.x, cell.y]), renderItem: (at, api) => {
        const cell = cells[at.dataIndex], [x, y] = api.coord([cell.x - 0.5, cell.y + 0.5]);
        const [width, height] = api.size([1, 1]), share = placeOn({}, means, cell.mean);
        return { type: "rect", shape: { x: x + 1, y: y + 1, width: width - 2, height: height - 2 },
          style: { fill: echarts.color.lerp(share, ramp()) },
          textContent: { style: { text: short(cell.mean) + "\n(" + cell.count + ")", align: "center",
            lineHeight: 15, fill: share < 0.6 ? "#ffffff" : "#000000" } }, textConfig: { position: "inside" } };
      } }],
    }) }];
  }

  function timeline(chart) {
    const rows = chart.y.labels.length;
    return [{ height: () => Math.max(180, Math.min(640, 90 + rows * 16)), option: (narrow) => {
      const option = frame(chart.x, chart.y, narrow, {
        tooltip: { formatter: (at) => tip([chart.bars[at.dataIndex].text, chart.y.labels[chart.bars[at.dataIndex].row]]) },
        series: [{ type: "custom", clip: true, encode: { x: [1, 2], y: 0 },
          data: chart.bars.map((bar) => [bar.row, bar.start, bar.end]), renderItem: (at, api) => {
            const [left, y] = api.coord([api.value(1), api.value(0)]), [right] = api.coord([api.value(2), api.value(0)]);
            const height = Math.max(2, 0.8 * api.size([0, 1])[1]);
            return { type: "rect", shape: { x: left, y: y - height / 2, width: Math.max(2, right - left), height },
              style: { fill: color(chart.bars[at.dataIndex].color), stroke: color("page"), lineWidth: 0.5 } };
          } }],
      });
      option.yAxis.inverse = true;
      option.yAxis.nameLocation = "start";
      option.yAxis.axisLabel.interval = "auto";
      return option;
    } }];
  }

  const timelineKeys = (chart) => [...new Map(chart.bars.map((bar) => [bar.status, bar.color]))]
    .map(([name, key]) => ({ name, color: key, mark: "bar" }));

  const heatKeys = (chart) => [{ name: "mean of " + chart.score.name, ramp: extent(chart.cells.map((cell) => cell.mean)).map(short) }];

  const KINDS = {
    panels: [panels, panelKeys], parallel: [parallel, parallelKeys], plots: [plots, plotKeys],
    heat_map: [heatMap, heatKeys], timeline: [timeline, timelineKeys],
  };

  // ---- The page

  function keyElement(key, chart) {
    const mark = element("span", "mark " + (key.ramp ? "ramp" : key.mark ?? "dot"));
    if (!key.ramp) mark.style.setProperty("--mark", "var(--" + key.color + ")");
    const content = key.ramp ? [key.name + ": " + key.ramp[0] + " ", mark, " " + key.ramp[1]] : [mark, key.name];
    if (!key.toggles) return element("li", "", ...content);
    const button = element("button", "", ...content);
    button.type = "button";
    button.setAttribute("aria-pressed", "true");
    button.addEventListener("click", () => {
      const shows = !chart.hidden.delete(key.name) && Boolean(chart.hidden.add(key.name));
      button.setAttribute("aria-pressed", String(!shows));
      chart.drawings.forEach((drawing) => drawing.draw());
    });
    return element("li", "", button);
  }

  function addPlot(chart, box, made) {
    const place = element("div", "plot");
    const drawing = { place, draw: () => {
      const isMany = box.classList.contains("many"), paper = isMany ? PAPER_WIDTH / 2 - 10 : PAPER_WIDTH;
      const width = onPaper ? paper : place.clientWidth, narrow = width < (made.leastWidth ?? NARROW);
      const height = made.height?.(narrow) ?? (isMany ? 250 : 340);
      place.style.height = height + "px";
      drawing.chart ??= echarts.init(place, null, { renderer: "svg", width, height });
      drawing.chart.resize({ width, height });
      drawing.chart.setOption({
        animation: false, textStyle: { fontFamily: getComputedStyle(place).fontFamily },
        aria: { enabled: false }, ...themed(made.option(narrow)),
      }, { notMerge: true });
      if (made.after && !drawing.isListening) made.after(drawing.chart);
      drawing.isListening = true;
      drawing.width = width;
    } };
    box.append(made.title ? element("div", "", element("h4", "", made.title), place) : place);
    chart.drawings.push(drawing);
  }

  const themed = (option) => ({ ...option, tooltip: {
    confine: true, backgroundColor: color("card"), borderColor: color("grid"), textStyle: { color: color("ink"), fontSize: 12 },
    ...option.tooltip,
  } });

  const drawings = [];
  for (const box of document.querySelectorAll("[data-chart]")) {
    const chart = charts.find((item) => item.id === box.dataset.chart);
    Object.assign(chart, { hidden: new Set(), drawings: [], said: element("p", "quiet small said") });
    chart.said.setAttribute("aria-live", "polite");
    const [make, keys] = KINDS[chart.kind];
    const made = make(chart);
    box.classList.toggle("many", made.length > 1);
    box.before(element("ul", "keys", ...keys(chart).map((key) => keyElement(key, chart))));
    box.after(chart.said);
    made.forEach((plot) => addPlot(chart, box, plot));
    drawings.push(...chart.drawings);
  }

  const byPlace = new Map(drawings.map((drawing) => [drawing.place, drawing]));
  const nearView = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => {
    nearView.unobserve(entry.target);
    byPlace.get(entry.target).draw();
  }), { rootMargin: "300px" });
  const widths = new ResizeObserver((entries) => entries.forEach((entry) => {
    const drawing = byPlace.get(entry.target);
    if (drawing.chart && !onPaper && drawing.width !== drawing.place.clientWidth) drawing.draw();
  }));
  for (const { place } of drawings) {
    nearView.observe(place);
    widths.observe(place);
  }
  const redraw = () => drawings.filter((drawing) => drawing.chart).forEach((drawing) => drawing.draw());
  darkTheme.addEventListener("change", redraw);
  addEventListener("beforeprint", () => { onPaper = true; drawings.forEach((drawing) => drawing.draw()); });
  addEventListener("afterprint", () => { onPaper = false; redraw(); });
})();
