// Starts every part of the page, then connects.

import { startAnnotating } from "./annotate.js";
import { startAnnotatePanel } from "./annotate_panel.js";
import { startAnnotateScene } from "./annotate_scene.js";
import { startCamera } from "./camera.js";
import { startCompare } from "./compare.js";
import { startClusters } from "./clusters.js";
import { startDrawer } from "./drawer.js";
import { startKeys } from "./keys.js";
import { startLayers } from "./layers.js";
import { connect } from "./live.js";
import { startMap } from "./map.js";
import { startMarks } from "./marks.js";
import { startMeasure } from "./measure.js";
import { startOverlay } from "./overlay.js";
import { startPalette } from "./palette.js";
import { startPlots } from "./plots.js";
import { startScene } from "./scene.js";
import { startShare } from "./share.js";
import { startScores } from "./scores.js";
import { startSources } from "./sources.js";
import { startStages } from "./stages.js";
import { startStatus } from "./status.js";
import { startStory } from "./story.js";
import { startTable } from "./table.js";
import { startTabs } from "./tabs.js";
import { startTheme } from "./theme.js";
import { startTimeline } from "./timeline.js";
import { startTunePanel } from "./tune_panel.js";
import { startTuning } from "./tune.js";
import { startWelcome } from "./welcome.js";

for (const start of [startTheme, startStatus, startTabs, startMap, startMeasure, startTable, startScores, startPlots, startClusters, startStory, startAnnotating, startAnnotatePanel, startAnnotateScene, startTunePanel, startTuning, startOverlay, startStages, startCompare, startCamera,
  startTimeline, startMarks, startSources, startScene, startLayers, startKeys, startPalette, startDrawer, startWelcome, startShare]) start();
connect();
