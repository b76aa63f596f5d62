// What is seen, as the address's fragment: a link reproduces it. "#/sweeps/NAME?sort=lr&trial=t0003".
export function read() {
  const [path, query = ""] = location.hash.replace(/^#/, "").split("?");
  const parts = path.split("/").filter(Boolean).map(decode);
  const params = Object.fromEntries(new URLSearchParams(query));
  if (parts[0] === "compare") return { view: "compare", params };
  if (parts[0] === "new") return { view: "new", params };
  if (parts[0] === "sweeps" && parts[2] === "play") return { view: "play", name: parts[1], params };
  if (parts[0] === "file") return { view: "file", params };
  if (parts[0] === "sweeps" && parts.length > 1) return { view: "sweep", name: parts[1], params };
  return { view: "sweeps", params };
}

function decode(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    // A person's own hand wrote it.
    return text;
  }
}

export function sweepAddress(name, params = {}) {
  return write(`/sweeps/${encodeURIComponent(name)}`, params);
}

export function playAddress(name, params = {}) {
  return write(`/sweeps/${encodeURIComponent(name)}/play`, params);
}

export const compareAddress = (names) => write("/compare", { sweeps: names.join(",") });

function write(path, params) {
  const known = Object.entries(params).filter(([, value]) => value !== null && value !== undefined && value !== "");
  const query = new URLSearchParams(known).toString();
  return `#${path}${query ? `?${query}` : ""}`;
}

// Change parameters of the address in place: looking around fills no history.
export function keep(changes) {
  const [path] = location.hash.replace(/^#/, "").split("?");
  const address = write(path || "/", { ...read().params, ...changes });
  if (address !== location.hash) history.replaceState(null, "", address);
}
