// The steps of a calibration for a limb, and the guidance of the daemon during the movement.

const LIMBS = [
  {
    joints: /knee|hip|ankle/,
    moves: ["walk", "squat", "sit", "circle", "foot"],
    text: ["Walk a few steps and squat.", "Sit down and stand up.", "Lift the leg and draw circles with the foot.", "Bend the foot up and down."],
  },
  {
    joints: /elbow|shoulder|wrist/,
    moves: ["swing", "bend", "hand"],
    text: ["Swing the arm forward and back.", "Bend the elbow and turn the palm.", "Circle the hand, and raise the arm sideways a few times."],
  },
  {
    joints: /lumbar|neck|trunk/,
    moves: ["bow", "side"],
    text: ["Bend forward and nod, most of the time.", "Turn and bend to both sides."],
  },
  { joints: /(?:)/, moves: ["bend"], text: ["Move every joint through its whole range, forward most of the time."] },
];

/** Return the steps for a limb; without cameras, the static pose is the only step. */
export function stepsOf(info, cameras) {
  const joints = info.joints ?? [];
  const limb = LIMBS.find((kind) => joints.some((name) => kind.joints.test(name))) ?? LIMBS.at(-1);
  const steps = [
    {
      phase: "align", optical: true, short: "Align", title: "Turn the plate", button: "Start aligning", figures: ["plate"],
      tasks: ["Fix all sensors on the plate with markers.", "Start, then turn the plate by hand about all three axes until the time is over."],
      note: "Once per laboratory, and again after a restart of a sensor without magnetometer.",
    },
    {
      phase: "static", short: "Stand still", title: "Stand still", button: "Start standing", figures: [limb === LIMBS[0] ? "stand" : "upright"],
      tasks: [cameras ? "Put on all sensors and markers." : "Put on all sensors.", "Stand upright with straight joints, facing one way.", "Start, and stay still until the time is over."],
      note: "Required every time the sensors are put on. If you move, the time starts again.",
    },
    {
      phase: "functional", optical: true, short: "Move", title: "Move every joint", button: "Start moving", figures: limb.moves,
      tasks: limb.text,
      note: "Once per subject, 45 to 60 s in view of the cameras. The page shows which movement is still missing.",
    },
  ];
  return steps.filter((step) => cameras || !step.optical);
}

/**
 * Return the parts of a text such as "knee: 2 of 12 flexions so far: walk, squat": the object,
 * the finding, and the remedy. A text of another form is a remedy as a whole.
 */
export function guidanceOf(text) {
  const found = /^([^:]+): (?:(.+): )?(.+)$/s.exec(text);
  return found ? { object: found[1], found: found[2] ?? "", remedy: found[3] } : { object: "", found: "", remedy: text };
}
