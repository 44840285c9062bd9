// Search results: names of dln_jax itself come before modules and names of the packages. The numbers are Sphinx's own.
var Scorer = {
  score: ([docname, title, anchor, descr, score, filename, kind]) =>
    kind === "object" && /^dln_jax\.\w+$/.test(title) && !anchor.startsWith("#module-") ? score + 100 : score,
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
