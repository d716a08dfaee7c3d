// Starts all parts of the dashboard, then connects to the server.

import { startAnnotating } from "../annotate/annotations.js";
import { startAnnotatePanel } from "../annotate/panel.js";
import { startSceneAnnotating } from "../annotate/pointer.js";
import { startClusters } from "../clusters/clusters.js";
import { showProblem } from "../core/problem.js";
import { startUnits } from "../core/coordinates.js";
import { connect } from "../core/live_feed.js";
import { startTheme } from "../core/theme.js";
import { startStory } from "../explain/story.js";
import { startMap } from "../map/map.js";
import { startMeasure } from "../map/measure.js";
import { startSources } from "../open/dialog.js";
import { startWelcome } from "../open/welcome.js";
import { startMarks } from "../playback/event_marks.js";
import { startTimeline } from "../playback/timeline.js";
import { startCharts } from "../charts/charts.js";
import { startCamera } from "../scene/camera.js";
import { startDimming } from "../scene/dimming.js";
import { startFocus } from "../scene/focus.js";
import { startLabels } from "../scene/labels.js";
import { startLayers } from "../scene/layers.js";
import { startOverlay } from "../scene/overlay.js";
import { startRepairPanel } from "../repair/panel.js";
import { startScenePanel } from "../scene/panel.js";
import { startScene } from "../scene/scene.js";
import { startStages } from "../scene/stages.js";
import { startViews } from "../scene/views.js";
import { startScores } from "../scores/scores.js";
import { startTable } from "../trees/table.js";
import { startCompare } from "../tune/compare.js";
import { startTunePanel } from "../tune/panel.js";
import { startTuning } from "../tune/parameters.js";
import { startExtensions } from "./extensions.js";
import { startKeys } from "./keys.js";
import { startLayout } from "./layout.js";
import { startPalette } from "./palette.js";
import { startSettings } from "./settings.js";
import { startShare } from "./share.js";
import { startStatus } from "./status.js";
import { restoreTab, startDrawer, startTabs } from "./tabs.js";

for (const start of [startTheme, startLayout, startStatus, startTabs, startMap, startMeasure, startTable, startScores, startCharts, startClusters, startStory, startAnnotating, startAnnotatePanel, startRepairPanel, startSceneAnnotating, startTunePanel, startTuning, startOverlay, startStages, startCompare, startCamera,
  startTimeline, startMarks, startSources, startScene, startScenePanel, startLabels, startDimming, startViews, startLayers, startFocus, startKeys, startSettings, startPalette, startDrawer, startWelcome, startShare, startUnits, startExtensions, restoreTab]) start();
addEventListener("unhandledrejection", ({ reason }) => showProblem(reason?.message ? reason : String(reason)));
connect();
