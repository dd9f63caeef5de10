// Names of flight modes: ArduPilot by kind of vehicle, and PX4.

const COPTER = { 0: "Stabilize", 1: "Acro", 2: "AltHold", 3: "Auto", 4: "Guided", 5: "Loiter",
  6: "RTL", 7: "Circle", 9: "Land", 11: "Drift", 13: "Sport", 16: "PosHold", 17: "Brake",
  18: "Throw", 20: "Guided NoGPS", 21: "Smart RTL", 22: "FlowHold", 23: "Follow", 27: "Auto RTL" };
const PLANE = { 0: "Manual", 1: "Circle", 2: "Stabilize", 3: "Training", 4: "Acro", 5: "FBWA",
  6: "FBWB", 7: "Cruise", 8: "Autotune", 10: "Auto", 11: "RTL", 12: "Loiter", 13: "Takeoff",
  15: "Guided", 17: "QStabilize", 18: "QHover", 19: "QLoiter", 20: "QLand", 21: "QRTL" };
const PX4 = { 1: "Manual", 2: "Altitude", 3: "Position", 4: "Auto", 5: "Acro", 6: "Offboard",
  7: "Stabilized" };
const PX4_AUTO = { 1: "Ready", 2: "Takeoff", 3: "Hold", 4: "Mission", 5: "Return", 6: "Land" };
const ARMED = 128;

function nameOf({ autopilot, mavtype, custom_mode: mode }) {
  if (autopilot?.type === "MAV_AUTOPILOT_PX4") {
    const main = (mode >> 16) & 255;
    return (main === 4 && PX4_AUTO[(mode >> 24) & 255]) || PX4[main];
  }
  if (autopilot?.type !== "MAV_AUTOPILOT_ARDUPILOTMEGA") return undefined;
  return (mavtype?.type === "MAV_TYPE_FIXED_WING" ? PLANE : COPTER)[mode];
}

/** The name of the mode, and whether it is armed; null without a HEARTBEAT. */
export function modeOf(heartbeat) {
  if (!heartbeat) return null;
  const mode = nameOf(heartbeat) ?? `mode ${heartbeat.custom_mode}`;
  return `${mode}, ${(heartbeat.base_mode?.bits ?? 0) & ARMED ? "armed" : "disarmed"}`;
}
