/* Second stage of the boot: the ROM copies its 256 bytes (with a CRC, see image.py) from flash to RAM and calls it. Reads
   the flash by the plain command 0x03, which every serial flash has, copies the program to RAM and starts it.
   SIZE: bytes of the program, a multiple of 4. Registers are those of the RP2040 data sheet, section 4.10. */
    .syntax unified
    .cpu cortex-m0plus
    .thumb
    .section .text
    ldr r0, =0x18000000  /* SSI */
    movs r1, #0
    str r1, [r0, #0x08]  /* off */
    movs r1, #8
    str r1, [r0, #0x14]  /* clock: system clock / 8 */
    ldr r1, =0x001F0300  /* 32-bit frames, "EEPROM read": command and address first, then data */
    str r1, [r0, #0x00]
    movs r1, #0
    str r1, [r0, #0x04]  /* one frame per read */
    ldr r1, =0x03000218  /* command 0x03 of 8 bits, address of 24 bits, all on one line */
    movs r2, #0xF4
    str r1, [r0, r2]
    movs r1, #1
    str r1, [r0, #0x08]  /* on: flash is memory now */
    ldr r0, =0x10000100
    ldr r1, =0x20000000
    ldr r2, =SIZE
    adds r2, r1, r2
copy:
    ldmia r0!, {r3}
    stmia r1!, {r3}
    cmp r1, r2
    blo copy
    ldr r0, =0x20000001
    bx r0
    .ltorg
