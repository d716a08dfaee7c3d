// A press that cannot be taken back asks once more.

const DOUBT = 4000; // [ms] in which a second press counts

// A handler of presses: the first one calls show(true), a second one acts; show(false) ends the question.
export function atSecondPress(show, act) {
  let doubting = 0;
  const settle = () => { clearTimeout(doubting); doubting = 0; show(false); };
  return () => {
    if (doubting) { settle(); return act(); }
    doubting = setTimeout(settle, DOUBT);
    show(true);
  };
}
