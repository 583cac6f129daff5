// The roles of a plan as text. Pure.

const MOST = 6; // larger numbers are rare: they stay if the text has them

// The numbers of cars that a form offers, with the one that is written.
export function countsWith(count) {
  const offered = Array.from({ length: MOST }, (_, index) => index + 1);
  return [...(count === "all" || count <= MOST ? offered : [...offered, count]), "all"];
}

// A bare word, unless YAML reads it as something else.
const BARE = /^[A-Za-z_][A-Za-z0-9_]*$/;
const OTHER = /^(true|false|null|yes|no|on|off|y|n)$/i;
const scalar = (value) => (typeof value === "string" && BARE.test(value) && !OTHER.test(value) ? value : JSON.stringify(value));
const written = (value) => (Array.isArray(value) ? `[${value.map(scalar).join(", ")}]` : scalar(value));

const line = ([name, fields]) =>
  `  ${scalar(name)}: {${Object.entries(fields)
    .filter(([, value]) => value !== "" && value !== null)
    .map(([field, value]) => `${field}: ${written(value)}`)
    .join(", ")}}\n`;

// The text with these roles in place of its own. All else stays, except comments among the roles.
export function withRoles(text, roles) {
  const block = `roles:${roles.length === 0 ? " {}" : ""}\n${roles.map(line).join("")}`;
  const lines = text.split("\n");
  const begin = lines.findIndex((each) => /^roles\s*:/.test(each));
  if (begin < 0) return text.trim() === "" ? block : `${block}${text}`;
  let end = begin + 1;
  while (end < lines.length && !/^[^\s#]/.test(lines[end])) end += 1;
  // Empty lines and comments at the margin before the next part belong to the next part.
  while (end > begin + 1 && end < lines.length && /^(#.*|\s*)$/.test(lines[end - 1])) end -= 1;
  return [...lines.slice(0, begin), block.trimEnd(), ...(end < lines.length ? lines.slice(end) : [""])].join("\n");
}
