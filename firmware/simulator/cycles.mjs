// Runs a program in the RAM of rp2040js, and prints the cycles between each "bkpt 1" and the next, and R0 at "bkpt 2".
import { readFileSync } from 'node:fs';
import { RP2040 } from 'rp2040js';

const RAM = 0x20000000;
const program = readFileSync(process.argv[2]);
const mcu = new RP2040(), core = mcu.core, marks = [];
let ended = false;
mcu.onBreak = (code) => {
  if (code === 1) marks.push(core.cycles);
  ended = code !== 1;
};
mcu.sram.fill(0);
mcu.sram.set(program);
core.SP = mcu.readUint32(RAM);
core.PC = mcu.readUint32(RAM + 4) & ~1;
while (!ended) core.executeInstruction();
process.stdout.write(`${JSON.stringify({ cycles: marks.slice(1).map((at, k) => at - marks[k]), result: core.registers[0] })}\n`);
