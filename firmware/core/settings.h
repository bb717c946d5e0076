/* Settings of the controller: those of the build, which the host can change and save. */
#ifndef SETTINGS_H
#define SETTINGS_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"
#include "speed.h"

/* Settings that make may give to a port: COUNTS and RATIO (also a fraction: 3/2) are the encoder's counts per turn and
   its turns per turn of the prism, MOST_RPM is the limit of the prism's speed. */
#ifndef COUNTS
#define COUNTS 4096
#endif
#ifndef RATIO
#define RATIO 1
#endif
#ifndef MOST_RPM
#ifdef __AVR__
#define MOST_RPM 1000
#else
#define MOST_RPM 3000
#endif
#endif
#ifndef REVERSED
#define REVERSED 0 /* 1: the magnetic encoder counts backwards */
#endif
#ifdef __AVR__
#define MOST_EDGES_PER_S 75000 /* per second, which the port counts */
#endif
_Static_assert((int32_t)COUNTS * RATIO > 0 && (int32_t)COUNTS * RATIO < (int32_t)1 << 24, "COUNTS * RATIO: 1 to 16777215");
_Static_assert(MOST_RPM > 0 && MOST_RPM <= 13000, "MOST_RPM: 1 to 13000"); /* over-speed is seen up to 16000 rpm */

enum encoder { QUADRATURE, MAGNETIC };
enum pulses {
    PULSES_TIMED,  /* ten per second, sent to the camera's trigger input */
    PULSES_INDEX,  /* one per turn at the index, sent to the camera's trigger input */
    PULSES_CAMERA, /* sent by the camera or another clock, and received */
};

struct settings {
    uint32_t counts_per_turn;               /* of the prism */
    int32_t most_rpm, most_ramp, stop_ramp; /* limits of commands [rpm, rpm/s], and slope of a stop */
    struct gains gains;
    int32_t host_timeout;                   /* silence of the host after which the motor stops [s]; 0: it goes on */
    int32_t undervoltage, overvoltage;      /* of the motor's supply, at which the motor stops [mV]; 0: at none */
    /* The host does not change these. */
    uint8_t encoder, pulses;
    bool has_index;
    uint16_t stall_ms;                      /* time at an eighth of the speed or less that is a stall */
};
extern const struct settings default_settings;

/* Value of the setting with a key below SETTINGS. */
int32_t settings_get(const struct settings *s, uint8_t key);

/* Change a setting. Returns false, and changes nothing, if there is no such setting or the value is out of its range. */
bool settings_set(struct settings *s, uint8_t key, int32_t value);

#endif
