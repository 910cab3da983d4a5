"""The style sheet: light and calm on a screen of any width, black on white on paper."""

STYLE = """
:root { --ink: #1b2330; --soft: #55606e; --line: #d9dee5; --wash: #f5f7f9; --blue: #1d5f9e; --orange: #c2560c; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue",
  "Noto Sans", "Liberation Sans", Arial, sans-serif; }
main { max-width: 980px; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1, h2, h3 { line-height: 1.25; overflow-wrap: anywhere; break-after: avoid; }
h1 { font-size: 2rem; margin: 0 0 1rem; letter-spacing: -0.01em; }
h2 { font-size: 1.35rem; margin: 0 0 0.75rem; padding-top: 0.9rem; border-top: 2px solid var(--ink); }
h3 { font-size: 1.05rem; margin: 1.75rem 0 0.5rem; }
p { margin: 0 0 0.75rem; }
p, li, figcaption { max-width: 46rem; overflow-wrap: anywhere; }
section { margin-top: 2.75rem; }
code, pre { font-family: ui-monospace, "SF Mono", "Cascadia Mono", "DejaVu Sans Mono", monospace; font-size: 0.85em; }
code { overflow-wrap: anywhere; }
pre { margin: 0 0 1rem; padding: 0.75rem 1rem; background: var(--wash); border: 1px solid var(--line);
  border-radius: 4px; white-space: pre-wrap; overflow-wrap: anywhere; }
.kind { margin: 0; color: var(--soft); font-size: 0.85rem; font-weight: 600; letter-spacing: 0.06em;
  text-transform: uppercase; }
.note, .timings, figcaption { color: var(--soft); font-size: 0.875rem; }
.alarm { color: #8f1d14; font-weight: 600; }

.facts { margin: 0; display: grid; gap: 0.2rem 0; font-size: 0.9375rem; }
.facts div { display: grid; grid-template-columns: 13rem 1fr; gap: 1rem; }
.facts dt { color: var(--soft); }
.facts dd { margin: 0; overflow-wrap: anywhere; }

.verdict { max-width: none; margin: 0 0 1.25rem; padding: 1rem 1.25rem; font-size: 1.125rem; line-height: 1.45;
  border: 1px solid; border-left-width: 8px; border-radius: 4px; }
.good { border-color: #2c7a4b; background: #f0f8f3; }
.care { border-color: #b57700; background: #fdf8ea; }
.bad { border-color: #a8281e; background: #fdf1ef; }
.figures { list-style: none; margin: 0 0 1.25rem; padding: 0; display: grid; gap: 0.75rem;
  grid-template-columns: repeat(4, 1fr); }
.figures li { padding: 0.75rem 0.9rem; border: 1px solid var(--line); border-radius: 4px; }
.figures span, .figures strong { display: block; }
.figures strong { font-size: 1.5rem; line-height: 1.3; white-space: nowrap; }
.what { font-size: 0.8125rem; font-weight: 600; }
.how { font-size: 0.8125rem; line-height: 1.4; color: var(--soft); }
.warnings h3 { margin-top: 0; }
.warnings ul { margin: 0; padding-left: 1.2rem; }
.warnings li { margin-bottom: 0.5rem; }

.scroll { overflow-x: auto; margin: 0 0 1rem; }
.scroll:focus-visible { outline: 2px solid var(--blue); outline-offset: 2px; }
table { border-collapse: collapse; width: 100%; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.4rem; }
th, td { padding: 0.3rem 0.6rem; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
th:first-child { padding-left: 0; }
thead th { color: var(--soft); font-weight: 600; vertical-align: bottom; border-bottom: 1px solid var(--soft); }
tbody th { font-weight: 600; }
td.number, th.number { text-align: right; white-space: nowrap; }
thead th.number { white-space: normal; }
tbody .words { overflow-wrap: anywhere; min-width: 4rem; }
.small { max-width: 36rem; }
.stacked tbody th { font-weight: 400; min-width: 14rem; }
.known { white-space: nowrap; }
.known::before { content: ""; display: inline-block; width: 0.6em; height: 0.6em; margin-right: 0.45em;
  border: 1.5px solid var(--blue); border-radius: 50%; }
.known.data::before { background: var(--blue); }
.known.prior::before { background: linear-gradient(90deg, var(--blue) 50%, #fff 50%); }

figure { margin: 1rem 0 1.5rem; }
.pictures { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem 1.5rem; align-items: end; }
figcaption { margin-top: 0.4rem; }
svg.picture { display: block; width: 100%; height: auto; }
.key { max-width: 460px; margin-bottom: 0.5rem; }
svg text { font-size: 13px; fill: var(--ink); }
svg .middle { text-anchor: middle; }
svg .end { text-anchor: end; }
svg .minor { font-size: 12px; }
svg .grid { stroke: #e3e7ec; stroke-width: 1; }
svg .axis, svg .zero { stroke: #66707d; stroke-width: 1; fill: none; }
svg .zero { stroke-width: 0.75; }
svg .bar.before { fill: #a9b1bb; }
svg .bar.after { fill: #7fb0db; }
svg .outline { fill: none; stroke-width: 1.75; stroke: var(--orange); }
svg .expected { fill: none; stroke: var(--ink); stroke-width: 1.5; }
svg .dot { fill: none; stroke-width: 3.6; stroke-linecap: round; }
svg .dot.before { stroke: #8b949f; }
svg .dot.after { stroke: var(--blue); }
svg .dot.held { stroke: var(--orange); stroke-linecap: square; }
svg .dot.beyond { stroke: #000; stroke-width: 7; }
svg .spot { fill: none; stroke-width: 7; stroke-linecap: round; }
svg .spot.square { stroke-width: 6; stroke-linecap: square; }
svg .cell { stroke-width: 0.3; }
svg .touch-halo { fill: none; stroke: #fff; stroke-width: 3.6; stroke-linecap: round; }
svg .touch { fill: none; stroke: #000; stroke-width: 2; stroke-linecap: round; }
svg .box { fill: none; stroke: #000; stroke-width: 1.5; }

@media screen and (max-width: 760px) {
  main { padding: 1.5rem 1rem 3rem; }
  h1 { font-size: 1.6rem; }
  .figures { grid-template-columns: 1fr 1fr; }
  .pictures { grid-template-columns: 1fr; }
  .facts div { grid-template-columns: 1fr; gap: 0; margin-bottom: 0.4rem; }
  .verdict { padding: 0.9rem 1rem; font-size: 1.0625rem; }
  .figures strong { font-size: 1.25rem; }
  th, td { padding: 0.3rem 0.45rem; }
  tbody th, thead th:first-child { position: sticky; left: 0; background: #fff; }
  .wide caption::after { content: "Swipe sideways for more"; display: block; font-weight: 400; color: var(--soft); }
  .stacked thead { display: none; }
  .stacked tr { display: block; padding: 0.5rem 0; border-bottom: 1px solid var(--line); }
  .stacked th, .stacked td, .stacked td.number { display: block; border: 0; padding: 0.1rem 0; text-align: left;
    white-space: normal; }
  .stacked td::before { content: attr(data-label) ": "; color: var(--soft); }
}

@page { size: A4; margin: 16mm 15mm 18mm;
  @bottom-right { content: counter(page) " / " counter(pages); font: 8pt sans-serif; } }
@media print {
  body { color: #000; font-size: 10pt; }
  main { max-width: none; padding: 0; }
  h1 { font-size: 20pt; }
  h2 { font-size: 13pt; }
  p, figcaption, li { max-width: none; orphans: 3; widows: 3; }
  section { margin-top: 8mm; }
  .note, .timings, .kind, figcaption, .what, .how, .facts dt, thead th { color: #000; }
  .verdict, pre { background: #fff; }
  svg text { fill: #000; }
  .facts { font-size: 9pt; }
  .facts code { font-size: 7.5pt; }
  .scroll { overflow: visible; }
  table:not(#parameter-table), #provenance { break-inside: avoid; }
  section > p:has(+ .scroll) { break-after: avoid; }
  table { font-size: 8.5pt; }
  th, td { padding: 0.8mm 1.5mm; }
  thead { display: table-header-group; }
  tr, svg, .verdict, .facts div, .figures li, pre, .key { break-inside: avoid; }
  figure { break-inside: avoid; }
  .figures strong { font-size: 13pt; }
  .pictures { grid-template-columns: 1fr 1fr; gap: 3mm 6mm; }
  .known::before, .known.data::before { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""
