// How results of the search are ordered: as Sphinx does, but what answers users comes before records and bare names.
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
