"""How a report looks in a browser, at any width and in print."""

from __future__ import annotations

STYLE = """
:root { color-scheme: light; --ink: #1b1f24; --soft: #57606a; --line: #d0d7de; --link: #0b5cad; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 78rem; margin: 0 auto; padding: 0.5rem 1.25rem 4rem; }
h1 { font-size: 1.5rem; line-height: 1.2; margin: 0.25rem 0; }
h2 { font-size: 1.3rem; margin: 2rem 0 0.5rem; padding-top: 0.75rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.1rem; margin: 2rem 0 0.5rem; }
p, ul { max-width: 46rem; }
a { color: var(--link); }
nav ul { display: flex; flex-wrap: wrap; gap: 0 1rem; list-style: none; padding: 0; margin: 0 0 0.5rem;
  max-width: none; font-size: 0.8rem; }
.side { display: grid; grid-template-columns: minmax(0, 1.1fr) minmax(0, 0.9fr); gap: 0 1.5rem; }
.side figure { margin: 0.4rem 0; }
.side table { font-size: 0.78rem; line-height: 1.2; }
.side th, .side td { padding-top: 0.18rem; padding-bottom: 0.18rem; padding-right: 0.35rem; }
.side th + th, .side td + td { padding-left: 0.35rem; }
.side figcaption { font-size: 0.8rem; margin: 0.2rem 0; }
.side ul { max-width: none; margin: 0.5rem 0; padding-left: 1.1rem; font-size: 0.85rem; line-height: 1.35; }
nav + p { max-width: none; margin: 0.3rem 0; font-size: 0.9rem; line-height: 1.4; }
details { margin: 0.6rem 0; border: 1px solid var(--line); border-radius: 4px; padding: 0 0.8rem; }
details[open] { padding-bottom: 0.5rem; }
summary { cursor: pointer; padding: 0.35rem 0; color: var(--link); }
code { font: 0.9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; background: #f2f4f6;
  padding: 0.1em 0.3em; border-radius: 3px; overflow-wrap: anywhere; }
figure { margin: 1rem 0; }
figcaption { color: var(--soft); font-size: 0.9rem; max-width: 46rem; margin: 0.5rem 0; }
.table figcaption { color: var(--ink); font-weight: 600; }
.scroll { overflow-x: auto; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 34rem), 1fr));
  gap: 0 1.5rem; }
.pictures > figure { min-width: 0; }
.pictures img { max-width: min(100%, 46rem); }
img { display: block; max-width: min(100%, 56rem); min-width: min(100%, 34rem); height: auto; }
table { border-collapse: collapse; font-size: 0.875rem; line-height: 1.35; font-variant-numeric: tabular-nums;
  border-top: 2px solid var(--ink); border-bottom: 2px solid var(--ink); }
th { text-align: left; vertical-align: bottom; border-bottom: 1px solid var(--ink); }
th, td { padding: 0.3rem 0.7rem 0.3rem 0; }
th + th, td + td { padding-left: 0.7rem; }
td { vertical-align: top; white-space: nowrap; }
.wide { font-size: 0.78rem; }
.wide th + th, .wide td + td { padding-left: 0.35rem; }
.wide th, .wide td { padding-right: 0.35rem; }
.words { white-space: normal; min-width: 14rem; }
.number { text-align: right; }
tr.first td { border-top: 1px solid var(--line); }
tbody tr:hover { background: #f6f8fa; }
.warnings { background: #fff8e5; border-left: 4px solid #bf8700; padding: 0.25rem 1rem; margin: 1rem 0; }
.warnings p { margin: 0.5rem 0; max-width: none; }
@media (max-width: 60rem) { .side { display: block; } }
@media (max-width: 40rem) {
  body { font-size: 15px; }
  main { padding: 0.75rem 0.9rem 3rem; }
  h1 { font-size: 1.5rem; }
  h2 { font-size: 1.25rem; margin-top: 2rem; }
  img, .pictures img { max-width: none; width: 38rem; min-width: 100%; }
  table { font-size: 0.8rem; }
  .label { position: sticky; left: 0; background: #fff; white-space: normal;
    min-width: 6.5rem; max-width: 8.5rem; box-shadow: 1px 0 0 var(--line); }
}
@media print { main { max-width: none; } .scroll { overflow: visible; } figure { break-inside: avoid; } }
"""
