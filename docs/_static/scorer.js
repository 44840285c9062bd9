// Search results: names of dln_jax itself come first, then headings of the guides, then modules and names of the packages. The
// numbers below the function are Sphinx's own.
var Scorer = {
  score: ([docname, title, anchor, descr, score, filename, kind]) => {
    if (kind === "object" && /^dln_jax\.\w+$/.test(title) && !anchor.startsWith("#module-")) return score + 100;
    return kind === "title" && !/^(api|gallery)\//.test(docname) ? score + 50 : score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
