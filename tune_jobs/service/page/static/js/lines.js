// Lines of trials, and what is made of them.
// A curve's columns as the points of one of its returns, training or evaluation; at most so many.
export function lineOf(curve, metric, mostPoints = 400) {
  const line = { x: [], y: [] };
  const values = curve?.[`${metric}_return`] ?? [];
  for (let index = 0; index < values.length; index += 1) {
    if (values[index] !== null) {
      line.x.push(curve.num_env_steps[index]);
      line.y.push(values[index]);
    }
  }
  return thin(line, mostPoints);
}

function thin(line, most) {
  const length = line.x.length;
  if (length <= most) return line;
  const picks = Array.from({ length: most }, (_, index) => Math.round((index * (length - 1)) / (most - 1)));
  return { x: picks.map((pick) => line.x[pick]), y: picks.map((pick) => line.y[pick]) };
}

export function valueAt(line, x) {
  const { x: xs, y: ys } = line;
  if (!xs.length || x < xs[0] || x > xs.at(-1)) return null;
  let low = 0;
  let high = xs.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (xs[middle] <= x) low = middle;
    else high = middle;
  }
  if (xs[high] === xs[low]) return ys[high];
  return ys[low] + ((ys[high] - ys[low]) * (x - xs[low])) / (xs[high] - xs[low]);
}

// Median and range over lines, where all of them have values; null: nowhere.
export function bandOf(lines, numPoints = 80) {
  const known = lines.filter((line) => line.x.length);
  if (known.length < 2) return null;
  const start = Math.max(...known.map((line) => line.x[0]));
  const stop = Math.min(...known.map((line) => line.x.at(-1)));
  if (!(stop > start)) return null;
  const band = { x: [], y: [], low: [], high: [], numSeeds: known.length };
  for (let index = 0; index < numPoints; index += 1) {
    const x = start + ((stop - start) * index) / (numPoints - 1);
    const values = known
      .map((line) => valueAt(line, x))
      .filter((value) => value !== null)
      .sort((a, b) => a - b);
    if (!values.length) continue;
    const middle = values.length / 2;
    band.x.push(x);
    band.y.push(values.length % 2 ? values[Math.floor(middle)] : (values[middle - 1] + values[middle]) / 2);
    band.low.push(values[0]);
    band.high.push(values.at(-1));
  }
  return band;
}

// The best return that any trial had shown, over the env steps that all had trained for by then. When a trial's
// iterations ended is taken from when it began and ended, as if it had trained at one speed; running ones train `now`.
export function bestSoFar(trials, curves, now) {
  const hasEvaluations = [...curves.values()].some((curve) => curve.evaluation_return.some((value) => value !== null));
  const moments = [];
  for (const trial of trials) {
    const curve = curves.get(trial.trial_id);
    if (!curve?.num_env_steps.length) continue;
    const { num_env_steps: steps } = curve;
    const values = hasEvaluations ? curve.evaluation_return : curve.training_return;
    const began = trial.started_at ?? 0;
    const lasted = Math.max(0, (trial.ended_at ?? (trial.status === "running" ? now : began + trial.time_s)) - began);
    const all = steps.at(-1) || 1;
    let before = 0;
    for (let index = 0; index < steps.length; index += 1) {
      moments.push([
        began + (lasted * steps[index]) / all,
        Math.max(0, steps[index] - before),
        values[index],
        trial.trial_id,
        steps[index],
      ]);
      before = Math.max(before, steps[index]);
    }
  }
  moments.sort((a, b) => a[0] - b[0]);
  const steps = [];
  let spent = 0;
  let best = -Infinity;
  for (const [, more, value, id, at] of moments) {
    spent += more;
    if (value !== null && value > best) {
      best = value;
      steps.push({ spent, best, id, at });
    }
  }
  return { steps, spent, hasEvaluations };
}

export function drawLine(context, places, line, isStepped = false) {
  const { x, y } = line;
  if (!x.length) return;
  context.moveTo(places.x(x[0]), places.y(y[0]));
  for (let index = 1; index < x.length; index += 1) {
    if (isStepped) context.lineTo(places.x(x[index]), places.y(y[index - 1]));
    context.lineTo(places.x(x[index]), places.y(y[index]));
  }
}
