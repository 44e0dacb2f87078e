// A ball comes down over a sensor of `capsense serve`; prints each electrode's change [fF].
const socket = new WebSocket("ws://127.0.0.1:8765");
socket.binaryType = "arraybuffer";
const say = (message) => socket.send(JSON.stringify(message));
const ball = { name: "ball", shape: "sphere", radius: 0.03, material: "water" };
let sequence = 0;

socket.onopen = () => {
  say({ type: "hello", protocol: 1 });
  say({ type: "open", sensor: 0 });
};

socket.onmessage = ({ data }) => {
  if (data instanceof ArrayBuffer) {
    const view = new DataView(data);
    const m = view.getUint32(12, true); // electrodes
    const delta = 40 + 24 + 8 * m * m; // header, summary, capacitances; then their change
    const own = [...Array(m).keys()].map((k) => view.getFloat64(delta + 8 * k * (m + 1), true));
    console.log(own.map((farads) => (1e15 * farads).toFixed(2)).join("  "));
    if (sequence === 20) return socket.close();
    const poses = { ball: { position: [0, 0, 0.08 - 0.002 * sequence] } };
    return say({ type: "poses", sensor: 0, sequence: sequence++, poses });
  }
  const message = JSON.parse(data);
  if (message.type === "error") console.error(message.code, message.message);
  if (message.type === "opened") {
    const body = [{ ...ball, pose: { position: [0, 0, 0.08] } }];
    say({ type: "scene", sensor: 0, sequence: sequence++, body });
  }
};
