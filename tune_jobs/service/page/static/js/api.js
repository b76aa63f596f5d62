// The REST interface. What it refuses comes as a problem document (RFC 9457), whose sentences are shown as they are.
const BASE = new URL("api/v1/", document.baseURI);

export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || `The service answered ${status}.`);
    this.status = status;
    this.hint = problem.hint || "";
    this.problems = problem.problems || [];
  }
}

export class Unreachable extends Error {
  // What somebody has sent is not sent again by itself.
  constructor({ isSent = false } = {}) {
    super("The service can't be reached.");
    this.hint = isSent
      ? "Check that it runs, then try again."
      : "Check that it runs; the page goes on by itself once it answers.";
    this.problems = [];
  }
}

export const address = (path) => new URL(path, BASE).href;
export const ofSweep = (name, rest = "") => `sweeps/${encodeURIComponent(name)}${rest}`;

async function problemOf(answer) {
  try {
    return await answer.json();
  } catch {
    return { detail: `The service answered ${answer.status} ${answer.statusText}.` };
  }
}

// The answer itself, where it was not refused.
export async function answerTo(path, { method = "GET", query = {}, body, headers = {}, signal } = {}) {
  const url = new URL(path, BASE);
  for (const [name, value] of Object.entries(query)) {
    if (value !== null && value !== undefined && value !== "") url.searchParams.set(name, value);
  }
  const request = { method, signal, headers: { Accept: "application/json", ...headers }, credentials: "same-origin" };
  if (body !== undefined) {
    request.headers["Content-Type"] = "application/json";
    request.body = JSON.stringify(body);
  }
  let answer;
  try {
    answer = await fetch(url, request);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Unreachable({ isSent: method !== "GET" });
  }
  if (!answer.ok) {
    const refused = new Refused(answer.status, await problemOf(answer));
    if (answer.status === 401 && path !== "login") dispatchEvent(new CustomEvent("sign-in-needed"));
    throw refused;
  }
  return answer;
}

export async function ask(path, options) {
  const answer = await answerTo(path, options);
  return answer.status === 204 ? null : answer.json();
}

// All items of a list that comes in pages; `onPart(items)` is called with what is there so far, if there is more.
export async function askAll(path, key, query = {}, onPart = () => {}) {
  const items = [];
  let cursor = null;
  do {
    const page = await ask(path, { query: { limit: 1000, ...query, cursor } });
    items.push(...page[key]);
    cursor = page.next_cursor;
    if (cursor) onPart(items);
  } while (cursor);
  return items;
}

// Random, as a key of one submission; crypto.randomUUID is missing where the page came without TLS.
export function randomKey() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
