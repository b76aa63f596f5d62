// What may stand at a place of a sweep file, by the JSON Schema of the sweep file.
import { placeOf, valueAtTop } from "./yaml_lines.js";

export class Completion {
  constructor(schema) {
    this.schema = schema;
  }

  // What may come at a position of the text: { from, items: [{ text, insert, about }] }; null: nothing is known.
  at(text, position) {
    const start = text.lastIndexOf("\n", position - 1) + 1;
    const before = text.slice(start, position);
    const line = text.slice(0, start).split("\n").length - 1;
    const key = /^(\s*)([\w.]*)$/.exec(before);
    if (key) return this.keys(text, line, key[1].length, key[2], position - key[2].length);
    const value = /^(\s*)([\w.]+)\s*:\s+([\w.-]*)$/.exec(before);
    if (value) return this.values(text, line, value[1].length, value[2], value[3], position - value[3].length);
    return null;
  }

  keys(text, line, indent, typed, from) {
    const { path, siblings } = placeOf(text, line, indent);
    const known = this.propertiesAt(path, text);
    const items = Object.entries(known)
      .filter(([name]) => name.startsWith(typed) && name !== typed && !siblings.has(name))
      .map(([name, schema]) => ({
        text: name,
        insert: this.isMapping(schema) ? `${name}:\n${" ".repeat(indent + 2)}` : `${name}: `,
        about: this.about(schema),
      }));
    return items.length ? { from, items } : null;
  }

  values(text, line, indent, name, typed, from) {
    const { path } = placeOf(text, line, indent);
    const schema = this.propertiesAt(path, text)[name];
    if (!schema) return null;
    const alternatives = this.alternatives(schema);
    const items = alternatives
      .flatMap(listedValues)
      .filter((value) => value !== null)
      .map((value) => ({ text: String(value), insert: String(value), about: "" }));
    // A domain of the search is a mapping of one key.
    for (const item of path[0] === "space" ? alternatives : []) {
      const keys = kindsIn(item);
      if (keys.length === 1) {
        items.push({ text: keys[0], insert: `{${keys[0]}: ${keys[0] === "layers" ? "{}" : "[]"}}`, back: 2, about: item.description ?? "" });
      }
    }
    const found = items.filter((item) => item.text.startsWith(typed) && item.text !== typed);
    return found.length ? { from, items: found } : null;
  }

  // A schema's alternatives without references.
  alternatives(schema, depth = 0) {
    if (!schema || depth > 8) return [];
    if (schema.$ref) return this.alternatives(this.schema.$defs[schema.$ref.split("/").at(-1)], depth + 1);
    const parts = schema.anyOf ?? schema.oneOf;
    return parts ? parts.flatMap((part) => this.alternatives(part, depth + 1)) : [schema];
  }

  // Some sections depend on other fields: the hyperparameters on the algorithm.
  top(text) {
    const sections = [this.schema.properties];
    for (const rule of this.schema.allOf ?? []) {
      const conditions = Object.entries(rule.if?.properties ?? {});
      const holds = conditions.every(([name, { const: value }]) => valueAtTop(text, name) === value);
      if (conditions.length && holds) sections.push(rule.then?.properties ?? {});
    }
    return sections;
  }

  propertiesAt(path, text) {
    let sections = this.top(text);
    for (const name of path) {
      sections = sections
        .map((properties) => properties[name])
        .filter(Boolean)
        .flatMap((schema) => this.alternatives(schema))
        .map((schema) => schema.properties)
        .filter(Boolean);
    }
    return Object.assign({}, ...sections);
  }

  // Whether a key opens a block of further keys, which begins on a line of its own.
  isMapping(schema) {
    const kinds = this.alternatives(schema).filter((item) => item.type !== "null");
    const isBlock = (item) => [item.type].flat().includes("object") && kindsIn(item).length !== 1;
    return kinds.length > 0 && kinds.every(isBlock);
  }

  about(schema) {
    const described = [schema, ...this.alternatives(schema)].find((item) => item.description);
    const known = schema.default !== undefined && schema.default !== null;
    return [described?.description, known && `Default: ${JSON.stringify(schema.default)}.`].filter(Boolean).join(" ");
  }
}

// A domain has one key, its kind, beside its condition.
const kindsIn = (schema) => Object.keys(schema.properties ?? {}).filter((key) => key !== "when");

function listedValues(schema) {
  if (schema.enum) return schema.enum;
  if (schema.const !== undefined) return [schema.const];
  return schema.type === "boolean" ? [true, false] : [];
}
