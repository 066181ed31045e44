// The order of search results is Sphinx's, but pages for users come before records, maintainers' pages and bare names.
const LATER = /^(comparisons|maintain|api|changelog|genindex)/;
var Scorer = {
  score: ([docname, , , , score]) => (LATER.test(docname) ? score - 20 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
