// Where each trial lies on the timeline: rows are the places that a node's trials had side by side, a process keeps its
// own while it trains, and pauses in which no trial ran are left out.
const LEAST_PAUSE = 0.1;
const SAME_RUN_S = 30;
const LAST_MOMENT = 1e12;

const isMoment = (time) => Number.isFinite(time) && time >= 0 && time < LAST_MOMENT;
// Ray's id behind the address says nothing to a reader.
const nodeOf = (trial) => (trial.node ?? "node not known").split("/")[0];

// When a trial ended; one that runs has lasted as long as it has trained.
function endOf(trial) {
  const end = isMoment(trial.ended_at) ? trial.ended_at : trial.started_at + trial.time_s;
  return isMoment(end) && end >= trial.started_at ? end : null;
}

// Returns { bars, nodes, blocks, numRows, first, lasted, cuts, paused, numWithout }: bars by when they began, each with
// its row and its seconds `from` and `to` since the first trial began; `lasted` and `cuts` are such seconds too.
export function layOut(trials) {
  const begun = trials.filter((trial) => trial.status !== "pending");
  const bars = [];
  for (const trial of begun) {
    const end = isMoment(trial.started_at) ? endOf(trial) : null;
    if (end !== null) bars.push({ trial, start: trial.started_at, end, row: 0 });
  }
  bars.sort((a, b) => a.start - b.start || a.trial.index - b.trial.index);
  const { nodes, blocks, numRows } = placeRows(bars);
  const pauses = pausesOf(bars);
  const first = bars[0]?.start ?? 0;
  const since = (time) => pauses.reduce((sum, pause) => (pause.end <= time ? sum - pause.lasts : sum), time - first);
  let lasted = 0;
  for (const bar of bars) {
    bar.from = since(bar.start);
    bar.to = since(bar.end);
    lasted = Math.max(lasted, bar.to);
  }
  for (const block of blocks) Object.assign(block, { from: since(block.start), to: since(block.end) });
  return {
    bars,
    nodes,
    blocks,
    numRows,
    first,
    lasted,
    cuts: pauses.map((pause) => since(pause.end)),
    paused: pauses.reduce((sum, pause) => sum + pause.lasts, 0),
    numWithout: begun.length - bars.length,
  };
}

// The times in which no trial ran, if they are long beside those in which some did.
function pausesOf(bars) {
  const pauses = [];
  let busy = 0;
  let until = null;
  for (const { start, end } of bars) {
    if (until !== null && start > until) pauses.push({ start: until, end: start, lasts: start - until });
    busy += Math.max(0, end - Math.max(start, until ?? start));
    until = Math.max(end, until ?? end);
  }
  return pauses.filter((pause) => pause.lasts > LEAST_PAUSE * busy);
}

function placeRows(bars) {
  const nodes = [];
  const blocks = [];
  let numRows = 0;
  for (const [name, members] of groupBy(bars, (bar) => nodeOf(bar.trial)).toSorted(byName)) {
    const runs = [...groupBy(members, processOf)].flatMap(([, own]) => runsOf(own));
    runs.sort((a, b) => a.start - b.start);
    const free = [];
    for (const run of runs) {
      const row = roomFor(free, run);
      for (let place = row; place < row + run.size; place += 1) free[place] = run.end;
      for (const bar of run.bars) bar.row = numRows + row + bar.place;
      if (run.bars.length > 1) blocks.push({ start: run.start, end: run.end, row: numRows + row, size: run.size });
    }
    nodes.push({ name, first: numRows, numRows: free.length });
    numRows += free.length;
  }
  return { nodes, blocks, numRows };
}

const byName = ([a], [b]) => a.localeCompare(b, "en", { numeric: true });
const processOf = (bar) => (Number.isInteger(bar.trial.pid) ? bar.trial.pid : `alone ${bar.trial.trial_id}`);

function groupBy(items, keyOf) {
  const groups = new Map();
  for (const item of items) {
    const key = keyOf(item);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(item);
  }
  return [...groups];
}

// The runs of one process' number: a process of a later launch may have the same one. Each bar gets its place within.
function runsOf(bars) {
  const runs = [];
  let run = null;
  for (const bar of bars) {
    if (run === null || bar.start > run.end + SAME_RUN_S) {
      run = { start: bar.start, end: bar.end, size: 0, bars: [], free: [] };
      runs.push(run);
    }
    const known = run.free.findIndex((end) => end <= bar.start);
    bar.place = known < 0 ? run.free.length : known;
    run.free[bar.place] = bar.end;
    run.size = run.free.length;
    run.end = Math.max(run.end, bar.end);
    run.bars.push(bar);
  }
  return runs;
}

// The first of so many neighbouring rows that are free, or that there is room for below the others.
function roomFor(free, { start, size }) {
  let first = 0;
  for (let row = 0; row < free.length && row - first < size; row += 1) if (free[row] > start) first = row + 1;
  return first;
}
