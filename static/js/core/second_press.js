// A press that cannot be taken back asks once more.

const DOUBT = 4000; // [ms]

// A handler of presses: the first one calls show(true), a second one within `doubt` [ms] acts; show(false) ends the
// question.
export function atSecondPress(show, act, doubt = DOUBT) {
  let doubting = 0;
  const settle = () => { clearTimeout(doubting); doubting = 0; show(false); };
  return () => {
    if (doubting) { settle(); return act(); }
    doubting = setTimeout(settle, doubt);
    show(true);
  };
}
