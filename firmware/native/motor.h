/* Simulated motor and encoder, for the core on a computer (native/board.c) and for the image on simavr (avr/board.c).

   Motor: voltage, back-EMF, inertia, friction, cogging, current limit, noise. Encoder: eccentric disc (once per turn),
   index pulse with a width, or a magnetic encoder with noise and non-linearity. Faults are switched by setting `values`. */
#ifndef MOTOR_H
#define MOTOR_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "controller.h"

#define STEP_US 50
#define TAU 6.283185307179586

/* What boards.py sets and gets, in this order. */
enum value {
    JAMMED, DRIVER_FAULT, NO_INDEX, DEAD_A, REVERSED_MOTOR, BAD_SPI, RUNAWAY,
    DEAD_ENCODER,   /* no edges; the magnetic encoder's angle stands still */
    LOST_COUNTS,    /* part of the counts that are lost, as by a coupling that slips */
    NO_MAGNET,      /* the magnetic encoder's angle is noise, and its diagnosis says so */
    ERROR_FLAG,     /* the magnetic encoder takes the next frame for damaged */
    BOUNCING_INDEX, /* three edges instead of one */
    ODD_INDEX,      /* a pulse in the middle of each turn */
    NO_SUPPLY,      /* the motor has no voltage; sensed by the pin if SENSED is set */
    SENSED, LOAD,   /* additional friction [rpm/s] */
    HEAVY,          /* inertia beside the usual one, as a part of it */
    VOLTS,          /* of the supply, where it is not lost */
    DIVIDER,        /* whether the supply's voltage is connected to its pin */
    BAD_STORE,      /* one bit of what is saved is not written */
    /* The motor, by default a DC motor on a belt */
    NO_LOAD,        /* speed without load at full voltage [rpm] */
    RISE,           /* time constant of motor and rotor [s] */
    COGGING, COGS,  /* amplitude [rpm/s], and periods per turn */
    FRICTION,       /* at rest [rpm/s] */
    MOST_PULL,      /* acceleration by the driver's current limit [rpm/s] */
    NOISE,          /* half of the width of the magnetic encoder's noise [counts] */
    INL,            /* its error once, and half of it twice per turn of the magnet [counts] */
    ANGLE, SPEED, VALUES
};

struct motor {
    double turns, rpm, values[VALUES];
    double lost; /* part of a count, of LOST_COUNTS */
    uint32_t per_turn, random;
    int64_t position; /* counts of the disc */
    int64_t unseen;   /* counts of it that the encoder has lost */
    bool in_pulse;
};

static double uniform(struct motor *m) { /* -1 to 1 */
    m->random = m->random * 1664525u + 1013904223u;
    return (double)(m->random >> 8) / 8388608.0 - 1.0;
}

static double read_turns(const struct motor *m) { return m->turns + 2e-4 * sin(TAU * m->turns); } /* eccentric disc */

static void motor_begin(struct motor *m, uint32_t per_turn, uint32_t seed) {
    m->per_turn = per_turn;
    m->random = seed;
    m->turns = 0.3;
    m->values[VOLTS] = 12;
    m->values[NO_LOAD] = 4000, m->values[RISE] = 0.15, m->values[MOST_PULL] = 1e9;
    m->values[COGGING] = 200, m->values[COGS] = 12, m->values[FRICTION] = 200, m->values[NOISE] = 1.5;
    m->position = (int64_t)floor(read_turns(m) * per_turn);
}

/* Turn for one step with a voltage of -1 to 1, if the driver is enabled. */
static void motor_turn(struct motor *m, bool enabled, double drive) {
    double dt = STEP_US * 1e-6;
    if (m->values[REVERSED_MOTOR] != 0) drive = -drive;
    if (m->values[RUNAWAY] != 0) drive = 1.3;
    bool driven = (enabled || m->values[RUNAWAY] != 0) && m->values[NO_SUPPLY] == 0;
    const double *v = m->values;
    double pull = driven ? (v[NO_LOAD] * drive - m->rpm) / (v[RISE] * (1 + v[HEAVY])) : 0; /* rpm per second */
    pull = fmax(-v[MOST_PULL], fmin(v[MOST_PULL], pull));
    pull += v[COGGING] * sin(v[COGS] * TAU * m->turns + 1.0) + 40.0 * sin(TAU * m->turns); /* cogging, unbalance */
    pull += 3000.0 * uniform(m) * fmin(1, fabs(m->rpm) / 50); /* noise, none at rest */
    double friction = (v[FRICTION] + m->values[LOAD] + 0.1 * fabs(m->rpm)) * dt;
    m->rpm += pull * dt;
    m->rpm = fabs(m->rpm) > friction ? m->rpm - copysign(friction, m->rpm) : 0;
    if (m->values[JAMMED] != 0) m->rpm = 0;
    m->turns += m->rpm / 60.0 * dt;
}

/* Let the encoder miss the last count of the disc, or not. */
static void motor_miss(struct motor *m, bool forward) {
    m->lost += m->values[DEAD_ENCODER] != 0 ? 1 : m->values[LOST_COUNTS];
    if (m->lost < 1) return;
    m->lost -= 1;
    m->unseen += forward ? 1 : -1;
}

/* Move the disc by one count towards the place that it has after a step, which began at `before` turns. Returns false if
   it is there, else sets `share`, the time of the count as a part of the step. */
static bool motor_count(struct motor *m, double before, double *share) {
    double from = before * m->per_turn, after = read_turns(m) * m->per_turn;
    int64_t to = (int64_t)floor(after);
    if (m->position == to) return false;
    bool forward = to > m->position;
    m->position += forward ? 1 : -1;
    motor_miss(m, forward);
    double at = (double)(forward ? m->position : m->position + 1);
    *share = fabs(after - from) > 0 ? fmin(fmax((at - from) / (after - from), 0), 1) : 0;
    return true;
}

static double motor_volts(const struct motor *m) { return m->values[NO_SUPPLY] != 0 ? 0 : m->values[VOLTS]; }

static uint8_t motor_levels(const struct motor *m) { /* 2 A + B, A leads */
    static const uint8_t levels[4] = {0, 2, 3, 1};
    uint8_t now = levels[(m->position - m->unseen) & 3];
    return m->values[DEAD_A] != 0 ? now & 1u : now;
}

/* Whether the level of the index has changed; the pulse is 1.4 degrees wide. */
static bool motor_index(struct motor *m) {
    int64_t phase = m->position % (int64_t)m->per_turn;
    if (phase < 0) phase += m->per_turn;
    bool in_pulse = phase < m->per_turn / 256 + 1;
    if (m->values[ODD_INDEX] != 0 && phase >= m->per_turn / 3 && phase < m->per_turn / 3 + 4) in_pulse = true;
    bool changed = in_pulse != m->in_pulse;
    m->in_pulse = in_pulse;
    return changed && m->values[NO_INDEX] == 0;
}

static inline double motor_get(const struct motor *m, int what) {
    return what == ANGLE ? m->turns * TAU : what == SPEED ? m->rpm : m->values[what];
}

#endif
