// Texts of others (people, gateways, files): without characters that nobody sees, and each with its own direction.

// Control and format characters: zero-width ones, and those that turn the direction of all that follows. Lines and tabs stay.
const UNSEEN = /[^\P{C}\n\t]/gu;
const RIGHT_TO_LEFT = /[\p{Script=Hebrew}\p{Script=Arabic}\p{Script=Syriac}\p{Script=Thaana}\p{Script=Nko}\p{Script=Adlam}]/u;
const [ISOLATE, END] = ["\u2068", "\u2069"]; // as <bdi>, also inside of a sentence or an attribute

const isolated = (line) => (RIGHT_TO_LEFT.test(line) ? `${ISOLATE}${line}${END}` : line);
export const seen = (text) => text.replace(UNSEEN, "").split("\n").map(isolated).join("\n");

// What is sent back stays as it is: the text of a plan, and what names a recording or a link.
const SENT_BACK = new Set(["text", "id", "name", "url"]);
const clean = (key, value) => (typeof value === "string" && !SENT_BACK.has(key) ? seen(value) : value);

// Messages come ten times a second. So only one that may have such a character (the console escapes it) is read slowly.
export const parse = (text) => JSON.parse(text, /\\u|[^\x20-\x7e]/.test(text) ? clean : undefined);
