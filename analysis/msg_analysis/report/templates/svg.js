"use strict";
// Drawings of SVG: for the pages that have no library.
const SVG = "http://www.w3.org/2000/svg";
const at = (id) => document.getElementById(id);

function element(kind, attributes, parent, text) {
  const made = document.createElementNS(SVG, kind);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}

// Round values, 1, 2 or 5 times a power of ten apart, about as many as wanted; how many decimals they have.
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted || 1, power = 10 ** Math.floor(Math.log10(rough));
  const apart = [1, 2, 5, 10].map((part) => part * power).find((part) => part >= rough * 0.999);
  const values = [];
  for (let place = Math.ceil(low / apart - 1e-9); place * apart <= high + 1e-9 * apart; place += 1) {
    values.push(Number((place * apart).toPrecision(12)));
  }
  return { values, decimals: Math.max(0, -Math.floor(Math.log10(apart) + 1e-9)) };
}
