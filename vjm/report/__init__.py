"""Results as users get them.

- result.json: `result_json`; model.json, written and read: `model_json`; which files a folder has: `output`.
- Sentences and tables, of the terminal, notebooks and report.html alike: `identification` (also of comparisons and
  checks) and `diagnosis`, which make a `Page`; numbers and effects in words: `text`.
- How a page looks on a terminal: `page`; in HTML: report.html.jinja, report.css and report.js. Pictures: `figures`;
  what moves: `interactive`, whose plots uPlot draws (uplot/: 1.6.32, MIT, as its authors publish it).
"""
