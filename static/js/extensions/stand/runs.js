// Parts of the page of runs: the report of a run, and two runs compared.

import { extend } from "../../shell/extensions.js";
import { showTwo } from "./compare.js";
import { reportMenu } from "./report.js";

extend(import.meta.url, {
  runButtons: (run, title) => [reportMenu("run-report", run.key, () => title)],
  pairViews: () => [showTwo],
});
