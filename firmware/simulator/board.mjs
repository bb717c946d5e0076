// Runs a flash image on rp2040js, with a simulated motor and encoder, in steps that the caller asks for.
//
// Lines on standard input: "run UNTIL_US HEX" gives bytes to the UART and runs; the answer is "NOW_US HEX", the time
// and the bytes sent. "set NAME VALUE" switches a fault, "get NAME" reads a value, "reset" resets the chip, "hang WHERE"
// lets the program hang until a reset. "usb HEX" gives bytes to the serial port of the simulated USB host (usb.mjs), "usb" reads
// from it, "usb open" and "usb close" open and close it. Without the argument "usb", no host is connected.
import { readFileSync } from 'node:fs';
import { createInterface } from 'node:readline';
import { RP2040 } from 'rp2040js';
import { UsbHost } from './usb.mjs';

const [path, kind, counts, bus] = process.argv.slice(2);
const image = readFileSync(path);
const magnetic = kind === 'MAGNETIC';
const STEP_NS = 50_000, TAU = 2 * Math.PI, BYTE_NS = 10e9 / 460_800;
const PIN = { a: 2, b: 3, index: 4, sync: 5, trigger: 6, direction: 9, enable: 10, fault: 11, supply: 12, cs: 17, adc: 26 };
const perTurn = Number(counts), absolute = magnetic && perTurn === 16384;  // then there is no index pulse
const faults = {
  jammed: 0, driver_fault: 0, no_index: 0, dead_a: 0, reversed_motor: 0, bad_spi: 0, runaway: 0, dead_encoder: 0,
  no_magnet: 0, error_flag: 0, bouncing_index: 0, no_supply: 0, sensed: 0, volts: 12, divider: 0, bad_store: 0,
};
const ERASE_US = 300_000;  // data sheets: 45 ms as a rule, 400 ms at most
const UPPER_OHM = 47_000, LOWER_OHM = 10_000, PULL_UP_OHM = 60_000;

// A serial flash of 2 MB: it outlives resets. A reset in the middle of an erase or a write leaves half of it done.
const flash = new Uint8Array(2 << 20).fill(0xff);
flash.set(image);
let flashBusyNs = -1, flashEnd = null, flashSent = [], flashSelected = false, writeEnabled = false;

function flashIsBusy() {
  if (flashEnd !== null && now() >= flashBusyNs) {
    flashEnd();
    flashEnd = null;
  }
  return flashEnd !== null;
}

function busyFor(us, begin, end) {
  begin();
  flashBusyNs = now() + 1000 * us;
  flashEnd = end;
  writeEnabled = false;
}

function flashAnswer(byte) {  // to a byte that is sent while the flash is selected
  const sent = flashSent, [command] = sent, at = (sent[1] << 16) | (sent[2] << 8) | sent[3];
  if (command === 0x05) return Number(flashIsBusy());
  if (command === 0x03 && sent.length >= 4 && !flashIsBusy()) return flash[(at + sent.length - 4) % flash.length];
  return 0xff;
}

function endOfCommand() {  // the flash is released: commands that change it begin
  const [command, high, middle, low, ...data] = flashSent, at = ((high << 16) | (middle << 8) | low) % flash.length;
  if (flashIsBusy()) return;
  if (command === 0x06) writeEnabled = true;
  if (!writeEnabled || flashSent.length < 4) return;
  if (command === 0x20) {
    const sector = at & ~0xfff;
    busyFor(ERASE_US, () => flash.fill(0xff, sector, sector + 0x800), () => flash.fill(0xff, sector, sector + 0x1000));
  } else if (command === 0x02) {
    const write = (from, to) => {
      for (let k = from; k < to; k++) {
        const place = (at & ~0xff) | ((at + k) & 0xff);
        flash[place] &= faults.bad_store && k === 20 ? 0 : data[k];
      }
    };
    const half = data.length >> 1;
    busyFor(700, () => write(0, half), () => write(half, data.length));
  }
}

function connectFlash() {  // the controller of the flash (SSI), with the override of its select line
  const ssi = mcu.peripherals[0x18000], io = mcu.peripherals[0x40018], registers = {};
  let received = [];
  flashSelected = false;
  flashEnd = null;  // the power was cut
  writeEnabled = false;
  ssi.writeUint32 = (register, value) => {
    registers[register] = value;
    if (register !== 0x60 || registers[0x08] !== 1) return;
    const ready = registers[0x00] === 7 << 16 && registers[0x10] === 1;  // bytes, both ways, one flash
    received.push(ready && flashSelected ? flashAnswer(value) : 0xff);
    if (ready && flashSelected) flashSent.push(value & 0xff);
  };
  ssi.readUint32 = (register) => {
    if (register === 0x28) return 6 | (received.length ? 8 : 0);
    return register === 0x60 ? received.shift() ?? 0xff : registers[register] ?? 0;
  };
  io.writeUint32 = (register, value) => {
    if (register !== 0x0c) return;
    const selected = ((value >> 8) & 3) === 2;
    if (selected && !flashSelected) flashSent = [];
    if (!selected && flashSelected) endOfCommand();
    flashSelected = selected;
  };
}

function supplyAtPin() {  // of the ADC, as a part of its 3.3 V
  const pulled = mcu.gpio[PIN.adc].pullupEnabled, impedance = (UPPER_OHM * LOWER_OHM) / (UPPER_OHM + LOWER_OHM);
  if (!faults.divider) return pulled ? 1 : 0.07;
  const volts = faults.no_supply ? 0 : faults.volts, pin = (volts * LOWER_OHM) / (UPPER_OHM + LOWER_OHM);
  return Math.min(1, (pin + (pulled ? ((3.3 - pin) * impedance) / (impedance + PULL_UP_OHM) : 0)) / 3.3);
}

let host = null, usbOut = [];
let mcu, clock, cycleNs = 8, out = [], inbox = [], arrivesNs = 0, resets = 0, watchdogs = 0;
let turns = 0.3, rpm = 0, position = Math.floor(turns * perTurn), inPulse = false, random = 1;
let unseen = 0;  // counts that a dead encoder has missed
let indexNs = [], triggerNs = [], triggerEndNs = [], enabledNs = [], fed = { times: 0, last_us: 0 };
const worst = {}, busy = {};  // cycles by number of the exception

const uniform = () => { random = (Math.imul(random, 1664525) + 1013904223) >>> 0; return (random >>> 8) / 8388608 - 1; };

function boot() {
  const was = clock?.nanos ?? 0;
  mcu = new RP2040();
  clock = mcu.clock;
  mcu.logger = { debug() {}, info() {}, warn() {}, error(_, text) { process.stderr.write(`rp2040js: ${text}\n`); } };
  mcu.flash.set(flash);
  connectFlash();
  mcu.adc.onADCRead = (channel) => {
    mcu.adc.currentChannel = channel;
    mcu.adc.channelValues[0] = Math.round(4095 * supplyAtPin());
    mcu.adc.sampleAlarm.schedule(2000);
  };
  mcu.sram.fill(0);
  offset = was + offset;
  mcu.core.VTOR = 0;
  mcu.core.SP = 0x20042000;
  mcu.core.PC = 0x10000000;  // the ROM calls the boot stage
  mcu.uart[0].onByte = (byte) => out.push(byte);
  mcu.pwm.channels[4].updateEnable = () => {};  // the duty is read from its register; its edges would take half the time
  if (bus === 'usb') {
    const after = (ms, action) => clock.createAlarm(action).schedule(ms * 1e6);
    host = new UsbHost(mcu.usbCtrl, mcu.usbDPRAM, after, (buffer) => usbOut.push(...buffer));
  }
  let answer = 0, errorFlag = false, selectedNs = 0, releasedNs = -1e9;
  mcu.gpio[PIN.cs].addListener((value) => {
    if (value !== 0) releasedNs = now();
    else {
      selectedNs = now();
      spiNs.between = Math.min(spiNs.between, selectedNs - releasedNs);
    }
  });
  mcu.spi[0].onTransmit = (word) => {  // an AS5047: a damaged frame sets a flag that stays until the errors are read
    if (mcu.gpio[PIN.cs].outputValue) return mcu.spi[0].completeTransmit(0xffff);  // not selected
    spiNs.before = Math.min(spiNs.before, now() - selectedNs);
    const sent = withParity(answer | (errorFlag ? 0x4000 : 0));
    if (faults.error_flag > 0 || ![0xffff, 0xfffc, 0x4001].includes(word)) {
      faults.error_flag = Math.max(faults.error_flag - 1, 0);
      errorFlag = true;
      answer = 0;
    } else if (word === 0xffff) answer = faults.no_magnet ? Math.floor(8192 * (1 + uniform())) & 0x3fff : angle();
    else if (word === 0xfffc) answer = faults.no_magnet ? 0x09ff : 0x0180;
    else {
      answer = Number(errorFlag);
      errorFlag = false;
    }
    mcu.spi[0].completeTransmit(faults.bad_spi ? sent ^ 1 : sent);
  };
  const watchdog = mcu.peripherals[0x40058], write = watchdog.writeUint32.bind(watchdog);
  watchdog.onWatchdogTrigger = () => {
    watchdog.alarm.enable = false;  // otherwise it would expire again and again at this time
    watchdogs++;
    boot();
  };
  watchdog.writeUint32 = (register, value) => {
    if (register === 4) fed = { times: fed.times + 1, last_us: now() / 1000 };
    write(register, value);
  };
  for (const name of ['a', 'b', 'index', 'sync']) mcu.gpio[PIN[name]].setInputValue(false);
  mcu.gpio[PIN.fault].setInputValue(!faults.driver_fault);
  mcu.gpio[PIN.supply].setInputValue(!(faults.no_supply && faults.sensed));
  mcu.gpio[PIN.trigger].addListener((value) => {
    if (value === 1) triggerNs.push(now());
    if (value === 0 && triggerNs.length > triggerEndNs.length) triggerEndNs.push(now());
  });
  mcu.gpio[PIN.enable].addListener((value) => { if (value === 1) enabledNs.push(now()); });
  const core = mcu.core, enter = core.exceptionEntry.bind(core), leave = core.exceptionReturn.bind(core), stack = [];
  core.exceptionEntry = (number) => { stack.push([number, core.cycles, 0]); enter(number); };
  core.exceptionReturn = (value) => {
    const [number, begun, nested] = stack.pop(), total = core.cycles - begun;
    worst[number] = Math.max(worst[number] ?? 0, total - nested);
    busy[number] = (busy[number] ?? 0) + total - nested;
    if (stack.length) stack[stack.length - 1][2] += total;
    leave(value);
  };
  levels();
  resets++;
}
const spiNs = { before: 1e9, between: 1e9 };  // shortest times from selection to clock, and between two frames [ns]
let offset = 0;  // time before the last reset [ns]
const now = () => offset + clock.nanos;

function levels() {
  const [a, b] = [[0, 0], [1, 0], [1, 1], [0, 1]][(position - unseen) & 3];
  const set = (pin, value) => { if (mcu.gpio[pin].rawInputValue !== !!value) mcu.gpio[pin].setInputValue(!!value); };
  set(PIN.a, a && !faults.dead_a && !magnetic);
  set(PIN.b, b && !magnetic);
  const phase = ((position % perTurn) + perTurn) % perTurn, pulse = phase < perTurn / 256 + 1 && !absolute;
  if (pulse !== inPulse) {
    inPulse = pulse;
    if (!faults.no_index) {
      if (pulse === rpm > 0) indexNs.push(now());
      set(PIN.index, pulse);
      for (let k = 1; faults.bouncing_index && k < 5; k++) {
        execute(now() + 3_000);  // less than a count
        set(PIN.index, pulse === (k % 2 === 0));
      }
    }
  }
}

const ENDLESS = 0x20041000;  // RAM that the program does not use

function hang(where) {  // the main loop or the tick's interrupt never ends, or the tick's interrupt never comes
  const core = mcu.core;
  mcu.writeUint16(ENDLESS, 0xe7fe);  // branch to itself
  if (where === 'loop') {
    while (core.IPSR) clock.tick(core.executeInstruction() * cycleNs);
    core.waiting = false;
    core.PC = ENDLESS;
  } else if (where === 'tick') {
    mcu.writeUint32(core.VTOR + 4 * 16, ENDLESS | 1);
  } else {
    core.enabledInterrupts &= ~1;
  }
}

const disc = () => (turns + 2e-4 * Math.sin(TAU * turns)) * perTurn;  // an eccentric disc

let lastAngle = 0;
function angle() {
  if (!faults.dead_encoder) lastAngle = Math.floor(disc() + 1.5 * uniform()) & 0x3fff;
  return lastAngle;
}

function withParity(word) {
  let parity = word;
  for (const k of [8, 4, 2, 1]) parity ^= parity >> k;
  return word | ((parity & 1) << 15);
}

function turn() {  // the same motor as native/board.c
  const dt = STEP_NS * 1e-9, enabled = mcu.gpio[PIN.enable].outputValue, duty = (mcu.pwm.channels[4].cc & 0xffff) / 5000;
  let drive = enabled ? (mcu.gpio[PIN.direction].outputValue ? duty : -duty) : 0;
  if (faults.reversed_motor) drive = -drive;
  if (faults.runaway) drive = 1.3;
  let pull = (enabled || faults.runaway) && !faults.no_supply ? (4000 * drive - rpm) / 0.15 : 0;
  pull += 200 * Math.sin(12 * TAU * turns + 1) + 40 * Math.sin(TAU * turns);
  pull += 3000 * uniform() * Math.min(1, Math.abs(rpm) / 50);
  const friction = (200 + 0.1 * Math.abs(rpm)) * dt;
  rpm += pull * dt;
  rpm = Math.abs(rpm) > friction ? rpm - Math.sign(rpm) * friction : 0;
  if (faults.jammed) rpm = 0;
  turns += (rpm / 60) * dt;
}

function execute(until) {  // the processor, until a time [ns]
  const core = mcu.core, chip = mcu;
  while (chip === mcu && now() < until) {
    if (core.waiting) {
      const next = clock.nextAlarm ? clock.nanosToNextAlarm : Infinity;
      clock.tick(Math.max(Math.min(until - now(), next), 0));
      if (core.waiting && next > until - now() && now() >= until - 1) break;
    } else {
      clock.tick(core.executeInstruction() * cycleNs);
    }
  }
}

function step() {
  const from = now(), before = disc();
  turn();
  const after = disc(), to = Math.floor(after), forward = to > position;
  if (!absolute) while (position !== to) {
    position += forward ? 1 : -1;
    if (faults.dead_encoder) unseen += forward ? 1 : -1;
    const at = forward ? position : position + 1;
    execute(from + (STEP_NS * (at - before)) / (after - before));
    levels();
  }
  while (inbox.length && arrivesNs <= from + STEP_NS) {
    execute(arrivesNs);
    mcu.uart[0].feedByte(inbox.shift());
    arrivesNs += BYTE_NS;
  }
  execute(from + STEP_NS);
}

boot();
resets = 0;
for await (const line of createInterface({ input: process.stdin })) {
  const [what, ...rest] = line.split(' ');
  if (what === 'run') {
    if (rest[1]) {
      if (!inbox.length) arrivesNs = now() + BYTE_NS;
      inbox.push(...Buffer.from(rest[1], 'hex'));
    }
    const until = Number(rest[0]) * 1000;
    while (now() < until) step();
    process.stdout.write(`${Math.floor(now() / 1000)} ${Buffer.from(out).toString('hex')}\n`);
    out = [];
  } else if (what === 'set') {
    faults[rest[0]] = Number(rest[1]);
    if (rest[0] === 'driver_fault') mcu.gpio[PIN.fault].setInputValue(!faults.driver_fault);
    mcu.gpio[PIN.supply].setInputValue(!(faults.no_supply && faults.sensed));
    if (rest[0] === 'sync') mcu.gpio[PIN.sync].setInputValue(!!faults.sync);
    process.stdout.write('\n');
  } else if (what === 'get') {
    const values = {
      rpm, angle: TAU * turns, index_us: indexNs.map((t) => t / 1000), trigger_us: triggerNs.map((t) => t / 1000),
      trigger_end_us: triggerEndNs.map((t) => t / 1000), spi_ns: spiNs,
      worst, busy, resets, watchdogs, fed, cycles: mcu.core.cycles, boot_us: offset / 1000,
      enable: mcu.gpio[PIN.enable].value === 1, enabled_us: enabledNs.map((t) => t / 1000),
      usb: host && { ...host.found, problems: host.problems, open: host.open },
      watchdog_resets: mcu.peripherals[0x40010].wdsel,
    };
    process.stdout.write(`${JSON.stringify(values[rest[0]])}\n`);
  } else if (what === 'usb') {
    if (rest[0] === 'open' || rest[0] === 'close') host.setOpen(rest[0] === 'open');
    else if (rest[0] === 'reset') host.reset();
    else if (rest[0]) host.feed(Buffer.from(rest[0], 'hex'));
    process.stdout.write(`${Buffer.from(usbOut).toString('hex')}\n`);
    usbOut = [];
  } else if (what === 'reset' || what === 'hang') {
    if (what === 'reset') boot();
    else hang(rest[0]);
    process.stdout.write('\n');
  }
}
