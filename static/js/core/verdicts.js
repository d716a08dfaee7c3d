// Verdicts by colour, letter and reason: never by colour alone.

const VERDICTS = {
  tree: ["T", "tree", "Taken as a stem; it feeds SLAM and the map."],
  pole: ["P", "pole", "A thin straight thing."],
  person: ["H", "person", "A person."],
  bush: ["B", "bush", "Scattered points, no stem."],
  wall: ["W", "other", "A flat thing."],
  other: ["O", "other", "Nothing that is known."],
  "too few points": ["F", "uncertain", "Not enough points to judge it."],
  "too round": ["R", "other", "λ1/λ2 is below Eccentricity min."],
  "too long": ["L", "other", "λ1/λ2 is above Eccentricity max."],
  "not round": ["S", "bush", "Distances to the axis scatter more than Radial deviation max."],
  "too thin": ["N", "pole", "The circle is below Radius min."],
  "too thick": ["K", "other", "The circle is above Radius max, or the cluster is wider than Width max."],
  "too low": ["D", "other", "It reaches over less than Visible height min."],
  "no arc": ["A", "uncertain", "Less of the circle is seen than Visible arc min."],
  "at border": ["E", "uncertain", "The pass-through box or the field of view cuts it."],
  moving: ["M", "person", "It moves."],
  hidden: ["X", "uncertain", "Something nearer hides its edge."],
};

// Of what is counted; what is not named here is no noun and stays as it is ("3 too few points").
const MANY = { tree: "trees", pole: "poles", person: "persons", bush: "bushes", wall: "walls", "other thing": "other things" };

// "1 bush", "33 bushes".
export const counted = (number, label) => `${number} ${number === 1 ? label : (MANY[label] ?? label)}`;

export const verdictOf = (label) => VERDICTS[label] ?? ["?", "other", ""];
