// Whole clouds: what is chosen before one is opened, and the stories of its stems.

import { extend } from "../../shell/extensions.js";
import { sourceChoice } from "./open.js";
import { clusterStory, treeEvidence, treeStory } from "./stems.js";

extend(import.meta.url, { clusterStory, sourceChoice, treeEvidence, treeStory });
