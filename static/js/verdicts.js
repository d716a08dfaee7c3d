// Verdicts by colour, letter and reason: never by colour alone.

export const VERDICTS = {
  tree: ["T", "tree", "Taken as a stem; it feeds SLAM and the map."],
  pole: ["P", "pole", "A thin straight thing."],
  person: ["M", "person", "A person."],
  bush: ["B", "bush", "Scattered points, no stem."],
  wall: ["W", "other", "A flat thing."],
  other: ["O", "other", "Nothing that is known."],
  "too few points": ["n", "uncertain", "Not enough points to judge it."],
  "too round": ["r", "other", "λ1/λ2 is below Eccentricity min."],
  "too long": ["l", "other", "λ1/λ2 is above Eccentricity max."],
  "not round": ["s", "bush", "Distances to the axis scatter more than Radial deviation max."],
  "too thin": ["t", "pole", "The circle is below Radius min."],
  "too thick": ["k", "other", "The circle is above Radius max, or the cluster is wider than Width max."],
  "too low": ["h", "other", "It reaches over less than Visible height min."],
  "no arc": ["a", "uncertain", "Less of the circle is seen than Visible arc min."],
  "at border": ["b", "uncertain", "The pass-through box or the field of view cuts it."],
  moving: ["v", "person", "It moves."],
  hidden: ["d", "uncertain", "Something nearer hides its edge."],
};

export const verdictOf = (label) => VERDICTS[label] ?? ["?", "other", ""];
