#include "encoder.h"

const int8_t quadrature_step[16] = {
    0, -1, 1, QUADRATURE_LOST, 1, 0, QUADRATURE_LOST, -1, -1, QUADRATURE_LOST, 0, 1, QUADRATURE_LOST, 1, -1, 0,
};

int as5047_angle(uint16_t frame) {
    uint16_t parity = frame ^ frame >> 8;
    parity ^= parity >> 4;
    parity ^= parity >> 2;
    parity ^= parity >> 1;
    return (parity & 1u) || (frame & 0x4000u) ? -1 : (int)(frame & 0x3FFFu);
}

bool as5047_has_no_magnet(uint16_t frame) {
    return !as5047_failed(frame) && (frame & 0x0B00u) != 0x0100u;
}
