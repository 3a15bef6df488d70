"use strict";
// What the other parts share: the data, the runs that are shown (the reference first), and a colour for each run on a light and on a dark page.

const DATA = JSON.parse(document.getElementById("data").textContent);
const SHOWN = [];
for (const [dark, k] of [[false, 0], [true, 1]]) {
  const rules = DATA.rungs.map((_, r) => `--run-${r}:${DATA.colours[r % DATA.colours.length][k]};`).join("");
  const style = document.createElement("style");
  style.textContent = dark ? `@media (prefers-color-scheme: dark) {:root {${rules}}}` : `:root {${rules}}`;
  document.head.append(style);
}
