// Stories of the stems of a whole cloud.

import { extend } from "../../shell/extensions.js";
import { clusterStory, treeEvidence, treeStory } from "./stems.js";

extend(import.meta.url, { clusterStory, treeEvidence, treeStory });
