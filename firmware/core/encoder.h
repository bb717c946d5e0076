/* Encoders: quadrature (A, B) and the frames of a magnetic SPI encoder of the AS5047 kind. */
#ifndef ENCODER_H
#define ENCODER_H

#include <stdbool.h>
#include <stdint.h>

#define AS5047_COUNTS 16384u
#define AS5047_READ_ANGLE 0xFFFFu /* read register 0x3FFF (ANGLECOM): bit 14 read, bit 15 even parity */

/* Step of the count, by the levels before and now: index 8 A' + 4 B' + 2 A + B. A leads B when the count increases.
   QUADRATURE_LOST marks a change of both levels: an edge was lost. */
#define QUADRATURE_LOST 2
extern const int8_t quadrature_step[16];

/* Return the angle in a 16-bit answer of the encoder, or -1 if its parity is odd or its error bit (14) is set. */
int as5047_angle(uint16_t frame);

#endif
