// A USB host for the simulated chip: it enumerates the device as an operating system does, opens its serial port, and
// checks what it sees by the USB 2.0 and CDC 1.20 specifications. Problems are collected, none is forgiven.
const CONTROL_IN = 0x80, AVAILABLE = 1 << 10, STALL = 1 << 11, DATA1 = 1 << 13, FULL = 1 << 15, ENABLED = 2 ** 31;
const RESET_MS = 10, RECOVERY_MS = 2, PATIENCE_MS = 50;

export class UsbHost {
  // `usb`: the chip's controller; `memory`: its packets; `after(ms, action)`: calls an action at a later time.
  constructor(usb, memory, after, received) {
    Object.assign(this, { usb, memory, after, received });
    this.problems = [];
    this.found = { device: null, configuration: null, strings: [], coding: null };
    this.open = false;  // the port: DTR
    this.outbox = [];
    this.pids = { in: 0, out: 0 };
    this.armedOut = null;
    this.requests = [];
    this.busy = false;
    this.stage = 'done';
    const updated = usb.DPRAMUpdated.bind(usb);
    usb.DPRAMUpdated = (offset, value) => {
      if (offset >= 0x80 && offset < 0x100) this.armed(offset, value);
      updated(offset, value);
    };
    usb.onUSBEnabled = () => after(1, () => this.reset());
    usb.onResetReceived = () => after(RESET_MS, () => this.enumerate());
    usb.onEndpointWrite = (endpoint, buffer) => this.sent(endpoint, buffer);
    usb.onEndpointRead = (endpoint, size) => this.ready(endpoint, size);
  }

  wrong(text) { this.problems.push(text); }

  reset() {
    if (!(this.usb.sieCtrl & (1 << 16))) this.wrong('the device is reset, but has no pull-up');
    this.usb.sieStatus |= 1 << 19;
    this.usb.sieStatusUpdated();
  }

  // What the device arms: the toggle of data must alternate, and nothing is armed on endpoints that are off.
  armed(offset, value) {
    const endpoint = (offset - 0x80) >> 3, out = !!(offset & 4);
    if (endpoint === 0 && value & STALL && !out) this.stalled();
    if (!(value & AVAILABLE)) return;
    const pid = value & DATA1 ? 1 : 0;
    if (!out && !(value & FULL)) this.wrong(`endpoint ${endpoint}: a packet is armed that is not full`);
    if (endpoint === 0) {
      this.controlPid = { ...this.controlPid, [out ? 'out' : 'in']: pid };
      return;
    }
    const control = new DataView(this.memory.buffer).getUint32(8 * endpoint + (out ? 4 : 0), true);
    if (!(control & ENABLED)) this.wrong(`endpoint ${endpoint} is armed, but off`);
    const key = out ? 'out' : 'in';
    if (pid !== this.pids[key]) this.wrong(`endpoint ${endpoint} ${key}: DATA${pid} after the same`);
    if (!out) this.pids.in ^= 1;
  }

  // A request, of which one is under way at a time. `data`: bytes to the device; done(bytes or null for a stall).
  ask(type, request, value, index, length, done, data = null) {
    this.requests.push({ type, request, value, index, length, done, data });
    this.next();
  }

  next() {  // one request at a time, with a pause
    if (this.busy || !this.requests.length) return;
    this.busy = true;
    this.after(1, () => this.begin());
  }

  begin() {
    if (!this.requests.length) return;  // the bus was reset meanwhile
    const { type, request, value, index, length } = this.requests[0];
    this.stage = type & CONTROL_IN && length ? 'in' : length ? 'out' : 'status in';
    this.bytes = [];
    this.nextPid = 1;
    this.controlPid = {};
    this.statusArmed = false;
    const setup = [type, request, value & 255, value >> 8, index & 255, index >> 8, length & 255, length >> 8];
    this.usb.epStallArm = 0;
    this.usb.sendSetupPacket(new Uint8Array(setup));
    const asked = this.requests[0];
    this.after(PATIENCE_MS, () => {
      if (this.requests[0] === asked) this.wrong(`request ${request.toString(16)}: no end in ${PATIENCE_MS} ms`);
    });
  }

  end(bytes) {
    const { done } = this.requests.shift();
    this.stage = 'done';
    done(bytes);
    this.busy = false;
    this.next();
  }

  stalled() {
    if (!this.requests.length) return;
    if (!(this.usb.epStallArm & 1)) this.wrong('a stall is not armed');
    this.after(0.1, () => this.end(null));
  }

  sent(endpoint, buffer) {  // by the device
    if (endpoint === 2) {
      if (buffer.length > 64) this.wrong(`a packet of ${buffer.length} bytes`);
      this.received(buffer);
      return;
    }
    if (endpoint !== 0 || !this.requests.length) return this.wrong(`endpoint ${endpoint}: data that nobody asked for`);
    const { length } = this.requests[0];
    if (this.stage === 'status in') {
      if (buffer.length || this.controlPid.in !== 1) this.wrong('the status stage is no empty DATA1');
      if (this.requests[0].request === 5 && this.requests[0].type === 0 && this.usb.addrEndp !== 0) this.wrong('a new address before the end of its request');
      this.end([]);
    } else if (this.stage === 'in') {
      if (this.controlPid.in !== this.nextPid) this.wrong('the toggle of a reply is wrong');
      this.nextPid ^= 1;
      this.bytes.push(...buffer);
      if (this.bytes.length > length) this.wrong('a reply is longer than asked for');
      if (buffer.length < 64 || this.bytes.length === length) this.stage = 'status out';
      this.finish();
    } else {
      this.wrong(`data in the stage ${this.stage}`);
    }
  }

  ready(endpoint, size) {  // the device can take a packet
    if (endpoint === 2) {
      this.armedOut = size;
      this.after(0.05, () => this.give());
    } else if (endpoint === 0 && this.stage === 'out') {
      if (this.controlPid.out !== 1) this.wrong('the data of a request is not DATA1');
      this.stage = 'status in';
      this.usb.endpointReadDone(0, new Uint8Array(this.requests[0].data));
    } else if (endpoint === 0 && (this.stage === 'in' || this.stage === 'status out')) {
      this.statusArmed = true;  // rp2040js reports a packet as sent some microseconds before its host has it
      this.finish();
    } else {
      this.wrong(`endpoint ${endpoint} waits for data in the stage ${this.stage}`);
    }
  }

  finish() {  // a reply, once it is complete and the device takes its status
    if (this.stage !== 'status out' || !this.statusArmed) return;
    if (this.controlPid.out !== 1) this.wrong('the status of a reply is not DATA1');
    this.stage = 'done';
    this.usb.endpointReadDone(0, new Uint8Array(0));
    this.after(0.1, () => this.end(this.bytes));
  }

  give() {  // the next bytes for the serial port
    if (this.armedOut === null || !this.outbox.length || !this.open) return;
    const size = Math.min(this.armedOut, 64, this.outbox.length);
    this.armedOut = null;
    this.pids.out ^= 1;
    this.usb.endpointReadDone(2, new Uint8Array(this.outbox.splice(0, size)));
  }

  feed(bytes) {
    this.outbox.push(...bytes);
    this.give();
  }

  setOpen(open) {
    this.ask(0x21, 0x22, open ? 3 : 0, 0, 0, (bytes) => {
      if (bytes === null) this.wrong('SET_CONTROL_LINE_STATE is refused');
      this.open = open;
      this.give();
    });
  }

  string(number, name) {
    if (!number) return;
    this.ask(CONTROL_IN, 6, 0x300 | number, 0x409, 255, (bytes) => {
      if (bytes === null || bytes[0] !== bytes.length || bytes[1] !== 3) return this.wrong(`string ${name}`);
      this.found.strings.push(String.fromCharCode(...bytes.slice(2).filter((_, k) => k % 2 === 0)));
    });
  }

  enumerate() {
    this.requests = [];
    this.busy = false;
    this.pids = { in: 0, out: 0 };
    this.ask(CONTROL_IN, 6, 0x100, 0, 64, (bytes) => {
      if (bytes?.length !== 18 || bytes[0] !== 18 || bytes[1] !== 1) this.wrong('device descriptor');
      else if (bytes[7] !== 64) this.wrong('size of endpoint 0');
    });
    this.ask(0, 5, 7, 0, 0, () => this.after(RECOVERY_MS, () => {
      if ((this.usb.addrEndp & 127) !== 7) this.wrong('the address is not taken');
    }));
    this.ask(CONTROL_IN, 6, 0x100, 0, 18, (bytes) => {
      this.found.device = bytes;
      this.string(bytes[14], 'manufacturer');
      this.string(bytes[15], 'product');
      this.string(bytes[16], 'serial number');
    });
    this.ask(CONTROL_IN, 6, 0x600, 0, 10, (bytes) => { if (bytes !== null) this.wrong('a device without high speed has a qualifier'); });
    this.ask(CONTROL_IN, 6, 0x300, 0, 255, (bytes) => { if (bytes?.join() !== '4,3,9,4') this.wrong('languages'); });
    this.ask(CONTROL_IN, 6, 0x363, 0x409, 255, (bytes) => { if (bytes !== null) this.wrong('a string that is not there'); });
    this.ask(CONTROL_IN, 6, 0x200, 0, 9, (bytes) => {
      const total = bytes[2] | (bytes[3] << 8);
      if (bytes.length !== 9) this.wrong('a part of the configuration is longer than asked for');
      this.ask(CONTROL_IN, 6, 0x200, 0, 255, (all) => {
        this.found.configuration = all;
        if (all.length !== total) this.wrong(`configuration: ${all.length} bytes, not ${total}`);
        this.ask(CONTROL_IN, 8, 0, 0, 1, (now) => { if (now?.[0] !== 0) this.wrong('configured too early'); });
        this.ask(0, 9, 2, 0, 0, (now) => { if (now !== null) this.wrong('configuration 2 is accepted'); });
        this.ask(0, 9, 1, 0, 0, (now) => {
          if (now === null) this.wrong('configuration 1 is refused');
          this.pids = { in: 0, out: 0 };
        });
        this.ask(CONTROL_IN, 8, 0, 0, 1, (now) => { if (now?.[0] !== 1) this.wrong('not configured'); });
        this.ask(CONTROL_IN, 0, 0, 0, 2, (now) => { if (now?.join() !== '0,0') this.wrong('status'); });
        const coding = [0x00, 0xc2, 0x01, 0x00, 2, 1, 7];  // 115,200 baud, 2 stop bits, odd, 7 bits
        this.ask(0x21, 0x20, 0, 0, 7, (now) => { if (now === null) this.wrong('SET_LINE_CODING'); }, coding);
        this.ask(0xa1, 0x21, 0, 0, 7, (now) => {
          this.found.coding = now;
          if (now?.join() !== coding.join()) this.wrong('GET_LINE_CODING');
        });
        this.ask(0xc0, 0x51, 0, 0, 4, (now) => { if (now !== null) this.wrong('an unknown request is answered'); });
        this.setOpen(true);
      });
    });
  }
}
