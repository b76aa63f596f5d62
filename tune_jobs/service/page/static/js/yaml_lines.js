// Where things stand in the text of a sweep file: enough of YAML's block style to name the line of a field.
const KEY = /^(\s*)(?:-\s+)?(?:"([^"]+)"|'([^']+)'|([A-Za-z_][\w.-]*))\s*:(?=\s|$)/;

// The keys of a text: { line (0 is the first), indent, path }.
export function keysOf(text) {
  const keys = [];
  const open = [];
  text.split("\n").forEach((content, line) => {
    const match = KEY.exec(content);
    if (!match) return;
    const indent = match[1].length;
    while (open.length && open.at(-1).indent >= indent) open.pop();
    const path = [...(open.at(-1)?.path ?? []), match[2] ?? match[3] ?? match[4]];
    const key = { line, indent, path };
    open.push(key);
    keys.push(key);
  });
  return keys;
}

// The line of a field such as "space.lr.loguniform", or that of the nearest one around it; null: none is there.
export function lineOfPath(text, path) {
  const wanted = path.split(/[.[\]]+/).filter(Boolean);
  const keys = keysOf(text);
  for (let length = wanted.length; length > 0; length -= 1) {
    const found = keys.find(
      (key) => key.path.length === length && key.path.every((part, index) => part === wanted[index]),
    );
    if (found) return found.line;
  }
  return null;
}

// The path of the mapping that a line with this indentation belongs to, and the keys that it has already.
export function placeOf(text, line, indent) {
  const before = keysOf(text.split("\n").slice(0, line).join("\n"));
  const parent = before.findLast(
    (key, index) => key.indent < indent && before.slice(index + 1).every((later) => later.indent > key.indent),
  );
  const path = parent?.path ?? [];
  const siblings = keysOf(text).filter(
    (key) =>
      key.line !== line && key.path.length === path.length + 1 && path.every((part, index) => key.path[index] === part),
  );
  return { path, siblings: new Set(siblings.map((key) => key.path.at(-1))) };
}

export function valueAtTop(text, name) {
  const match = new RegExp(`^${name}\\s*:\\s*["']?([\\w.-]+)`, "m").exec(text);
  return match ? match[1] : null;
}
