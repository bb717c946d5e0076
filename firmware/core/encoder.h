/* Encoders: quadrature (A, B) and the frames of a magnetic SPI encoder of the AS5047 kind. */
#ifndef ENCODER_H
#define ENCODER_H

#include <stdbool.h>
#include <stdint.h>

#define AS5047_COUNTS 16384u
/* Frames that read a register: bit 14 read, bit 15 even parity. The answer comes in the next frame. */
#define AS5047_READ_ANGLE 0xFFFFu     /* 0x3FFF, ANGLECOM */
#define AS5047_READ_DIAGNOSIS 0xFFFCu /* 0x3FFC, DIAAGC: field of the magnet */
#define AS5047_READ_ERRORS 0x4001u    /* 0x0001, ERRFL: reading it clears the error bit of all later answers */

/* Step of the count, by the levels before and now: index 8 A' + 4 B' + 2 A + B. A leads B when the count increases.
   QUADRATURE_LOST marks a change of both levels: an edge was lost. */
#define QUADRATURE_LOST 2
extern const int8_t quadrature_step[16];

/* Return the angle in a 16-bit answer of the encoder, or -1 if its parity is odd or its error bit (14) is set. */
int as5047_angle(uint16_t frame);

/* Whether an answer has its error bit set (it stays until AS5047_READ_ERRORS), or is damaged. */
static inline bool as5047_failed(uint16_t frame) { return as5047_angle(frame) < 0; }

/* Whether an answer to AS5047_READ_DIAGNOSIS says that the angle is not that of a magnet: bit 11 field too weak (the
   amplification, bits 7 to 0, is at its end), bit 9 overflow, bit 8 clear: not ready. False for a damaged answer. */
bool as5047_has_no_magnet(uint16_t frame);

#endif
