// Whole clouds: what is chosen before one is opened, the stories of its stems, and the cloud of a run as a file.

import { fileName } from "../../core/download.js";
import { saveWritten } from "../../core/written_file.js";
import { extend } from "../../shell/extensions.js";
import { sourceChoice } from "./open.js";
import { clusterStory, treeEvidence, treeStory } from "./stems.js";

const exportFiles = () => [
  { value: "laz", text: "Cloud as LAZ", edits: true, save: (title) => saveWritten("Writing the file …", fileName(title, "cloud.laz"), "/api/export/laz") },
];

extend(import.meta.url, { clusterStory, exportFiles, sourceChoice, treeEvidence, treeStory });
