// SPDX-License-Identifier: Apache-2.0
// The table of objects: scores, and errors where the truth is known.

import { colorOf } from "./data.js";

export class Objects {
  /** head, body: of the table; details: what is said of the chosen object; onPick(index). */
  constructor(head, body, details, onPick) {
    Object.assign(this, { head, body, details, onPick });
  }

  show(data) {
    this.data = data;
    const withErrors = data.truth !== null;
    this.head.replaceChildren(row("th", ["object", "score", ...(withErrors ? ["cm", "°", "size", "IoU"] : [])]));
    this.rows = data.objects.map((object) => {
      const cells = [`${String(object.index).padStart(2, "0")} ${object.category}`, object.score.toFixed(2)];
      const line = row("td", [...cells, ...(withErrors ? errorCells(object.error) : [])]);
      const dot = document.createElement("span");
      dot.className = "dot";
      dot.style.background = colorOf(object.category);
      line.firstChild.prepend(dot);
      if (object.error) line.firstChild.classList.add(object.error.found ? "good" : "miss");
      line.tabIndex = 0;
      line.addEventListener("click", () => this.onPick(object.index));
      line.addEventListener("keydown", (event) => { if (event.key === "Enter") this.onPick(object.index); });
      return line;
    });
    this.body.replaceChildren(...this.rows);
    this.select(null);
  }

  /** Fade what is below a score; returns how many are above it and which true objects these found. */
  setScore(least) {
    const shown = this.data.objects.filter((object) => object.score >= least);
    this.data.objects.forEach((object, index) => this.rows[index].classList.toggle("weak", object.score < least));
    return { shown: shown.length, found: new Set(shown.filter((object) => object.error?.found).map((object) => object.error.truth)) };
  }

  select(index) {
    this.rows.forEach((line, number) => line.classList.toggle("selected", number === index));
    const object = this.data.objects[index];
    this.details.textContent = object ? describe(object, this.data.truth !== null) : "";
    this.rows[index]?.scrollIntoView({ block: "nearest" });
  }
}

function describe(object, withErrors) {
  const metres = (values) => values.map((value) => value.toFixed(2)).join(" × ");
  const sure = object.confidence === undefined ? "" : `, confidence ${object.confidence.toFixed(2)}`;
  const views = object.num_views === undefined ? "" : `, seen by ${Math.round(object.num_views)} views${sure}`;
  const cad = object.id_cad ? `, CAD ${object.catid_cad}/${object.id_cad}` : "";
  const text = `${metres(object.size)} m (width × height × depth) at (${object.center.map((v) => v.toFixed(2)).join(", ")})${views}${cad}.`;
  if (!withErrors) return text;
  if (!object.error) return `${text} There is no true object of its class.`;
  return `${text} ${object.error.found ? "Found" : "Nearest of its class, but not within the limits or found by a surer one"}: true object ${object.error.truth}.`;
}

function errorCells(error) {
  if (!error) return ["–", "–", "–", "–"];
  return [
    (100 * error.translation_m).toFixed(1),
    error.rotation_deg.toFixed(0),
    `${Math.round(100 * error.scale)} %`,
    error.iou.toFixed(2),
  ];
}

function row(kind, texts) {
  const line = document.createElement("tr");
  for (const text of texts) {
    const cell = document.createElement(kind);
    cell.textContent = text;
    line.append(cell);
  }
  return line;
}
