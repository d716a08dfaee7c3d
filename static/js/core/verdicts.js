// Letter, colour and explanation of each verdict.

const VERDICTS = {
  tree: ["T", "tree", "A stem in this scan: SLAM uses it. Whether it is a tree of the map is decided by all scans that saw it."],
  pole: ["P", "pole", "A thin straight object."],
  person: ["H", "person", "A person."],
  bush: ["B", "bush", "Scattered points without a stem."],
  wall: ["W", "other", "A flat object."],
  other: ["O", "other", "An object of no known class."],
  "too few points": ["F", "uncertain", "Fewer points than a verdict needs."],
  "too round": ["R", "other", "Its eccentricity is below Minimum eccentricity."],
  "too long": ["L", "other", "Its eccentricity is above Maximum eccentricity."],
  "not round": ["S", "bush", "The radial deviation of its points is above Maximum radial deviation."],
  "too thin": ["N", "pole", "The radius of the fitted circle is below Minimum radius."],
  "too thick": ["K", "other", "The radius of the fitted circle is above Maximum radius (Maximum radius in a cloud), or the cluster is wider than Maximum width."],
  "too low": ["D", "other", "Its visible height is below Minimum visible height."],
  "no arc": ["A", "uncertain", "The visible arc of the circle is below Minimum visible arc."],
  "at border": ["E", "uncertain", "It is cut by the pass-through box or the field of view."],
  moving: ["M", "person", "It moves or has moved away."],
  stump: ["U", "other", "Round as a stem, but it ends below breast height."],
  hidden: ["X", "uncertain", "Its edge is occluded by a nearer object."],
};

// Plurals; a label that is missing here is not a noun and stays as it is ("3 too few points").
const MANY = { tree: "trees", pole: "poles", person: "persons", bush: "bushes", wall: "walls", stump: "stumps", "other object": "other objects" };

// "1 bush", "33 bushes".
export const counted = (number, label) => `${number} ${number === 1 ? label : (MANY[label] ?? label)}`;

export const verdictOf = (label) => VERDICTS[label] ?? ["?", "other", ""];
