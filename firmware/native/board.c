/* The controller on a computer, with a simulated motor and encoder, in simulated time: a library for Python's ctypes.

   Motor: voltage, back-EMF, inertia, friction, cogging, noise. Encoder: eccentric disc (once per turn), index pulse with
   a width, or a magnetic encoder with noise. Faults are switched by board_set(). */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "controller.h"

#define STEP_US 50
#define TAU 6.283185307179586

enum value { JAMMED, DRIVER_FAULT, NO_INDEX, DEAD_A, REVERSED_MOTOR, BAD_SPI, RUNAWAY, ANGLE, SPEED, VALUES, TIME, LATE, SYNC };

struct board {
    struct controller c;
    struct settings settings;
    uint64_t now, booted, ticked; /* simulated time; of the reset; of the last tick [us] */
    double clock_start, rate;     /* controller's clock at the reset [us], and its rate */
    double turns, rpm, late_us;   /* state of the motor; largest delay of an index latch [us] */
    double values[VALUES];
    int64_t position;             /* counts of the disc */
    int in_pulse;
    uint32_t random;
};

static double uniform(struct board *b) { /* -1 to 1 */
    b->random = b->random * 1664525u + 1013904223u;
    return (double)(b->random >> 8) / 8388608.0 - 1.0;
}

static uint32_t clock_at(const struct board *b, double now) {
    return (uint32_t)(int64_t)floor(b->clock_start + (now - (double)b->booted) * b->rate);
}

void board_reset(struct board *b) {
    controller_begin(&b->c, &b->settings, 0);
    b->booted = b->ticked = b->now;
    b->clock_start = 0;
}

struct board *board_new(uint32_t counts, int magnetic, int pulses, double drift_ppm, double clock_start, uint32_t seed) {
    struct board *b = calloc(1, sizeof *b);
    if (!b) return 0;
    b->settings = default_settings;
    b->settings.counts_per_turn = magnetic ? AS5047_COUNTS : counts;
    b->settings.encoder = magnetic ? MAGNETIC : QUADRATURE;
    b->settings.pulses = (uint8_t)pulses;
    b->rate = 1 + drift_ppm * 1e-6;
    b->random = seed;
    b->turns = 0.3;
    b->position = (int64_t)floor(b->turns * b->settings.counts_per_turn);
    board_reset(b);
    b->clock_start = clock_start;
    b->c.heard = b->c.checked_at = clock_at(b, 0);
    return b;
}

void board_set(struct board *b, int what, double value) { b->values[what] = value; }
double board_get(const struct board *b, int what) {
    if (what == ANGLE) return b->turns * TAU;
    if (what == SPEED) return b->rpm;
    return what == LATE ? b->late_us : what == TIME ? (double)b->now : what == SYNC ? b->c.pulse_number : b->values[what];
}

static void turn(struct board *b) {
    double dt = STEP_US * 1e-6, drive = b->c.enabled ? b->c.duty / (double)FULL_DUTY : 0;
    if (b->values[REVERSED_MOTOR] != 0) drive = -drive;
    if (b->values[RUNAWAY] != 0) drive = 1.3;
    double pull = b->c.enabled || b->values[RUNAWAY] != 0 ? (4000.0 * drive - b->rpm) / 0.15 : 0;      /* rpm per second */
    pull += 200.0 * sin(12 * TAU * b->turns + 1.0) + 40.0 * sin(TAU * b->turns); /* cogging, unbalance */
    pull += 3000.0 * uniform(b) * fmin(1, fabs(b->rpm) / 50); /* noise, none at rest */
    double friction = (200.0 + 0.1 * fabs(b->rpm)) * dt;
    b->rpm += pull * dt;
    b->rpm = fabs(b->rpm) > friction ? b->rpm - copysign(friction, b->rpm) : 0;
    if (b->values[JAMMED] != 0) b->rpm = 0;
    b->turns += b->rpm / 60.0 * dt;
}

static double read_turns(const struct board *b) { return b->turns + 2e-4 * sin(TAU * b->turns); } /* eccentric disc */

static void move(struct board *b, double before) {
    double per_turn = b->settings.counts_per_turn, after = read_turns(b) * per_turn;
    int64_t to = (int64_t)floor(after), first = b->position, span = llabs(to - first);
    static const uint8_t levels[4] = {0, 2, 3, 1}; /* 2 A + B, A leads */
    while (b->position != to) {
        b->position += to > b->position ? 1 : -1;
        double at = (double)(to > first ? b->position : b->position + 1);
        double share = fabs(after - before) > 0 ? (at - before) / (after - before) : 0;
        double when = (double)b->now + STEP_US * (span ? share : 0);
        uint8_t now = levels[b->position & 3];
        on_edge(&b->c, b->values[DEAD_A] != 0 ? now & 1u : now);
        int64_t phase = b->position % (int64_t)per_turn;
        if (phase < 0) phase += (int64_t)per_turn;
        int in_pulse = phase < (int64_t)(per_turn / 256) + 1; /* 1.4 degrees wide */
        if (in_pulse != b->in_pulse && b->values[NO_INDEX] == 0) {
            double late = 0.5 * (uniform(b) + 1.0); /* delay of the interrupt [us] */
            uint32_t t = clock_at(b, when + late);
            if (on_index(&b->c, t, in_pulse)) {
                b->late_us = fmax(b->late_us, late);
                if (b->settings.pulses == PULSES_INDEX) on_sync(&b->c, t);
            }
        }
        b->in_pulse = in_pulse;
    }
}

static void magnetic(struct board *b) {
    double angle = read_turns(b) * AS5047_COUNTS + 1.5 * uniform(b);
    uint16_t frame = (uint16_t)((int64_t)floor(angle) & 0x3FFF), parity = frame;
    for (int k = 8; k; k /= 2) parity ^= parity >> k;
    frame |= (uint16_t)((parity & 1u) << 15);
    if (fabs(b->values[BAD_SPI]) > 0 && (b->values[BAD_SPI] >= 1 || fabs(uniform(b)) < b->values[BAD_SPI])) frame ^= 1u;
    on_answer(&b->c, frame);
}

void board_feed(struct board *b, const uint8_t *bytes, uint32_t size) {
    for (uint32_t k = 0; k < size; k++) {
        on_byte(&b->c, bytes[k]);
        if (k % 64 == 63) controller_poll(&b->c, clock_at(b, (double)b->now)); /* the main loop is faster than the line */
    }
}

/* A pulse of the camera, now. */
void board_pulse(struct board *b) { on_sync(&b->c, clock_at(b, (double)b->now)); }

uint32_t board_advance(struct board *b, uint64_t until, uint8_t *out, uint32_t room) {
    uint32_t written = 0;
    while (b->now < until) {
        double before = read_turns(b) * b->settings.counts_per_turn;
        turn(b);
        if (b->settings.encoder == QUADRATURE) move(b, before);
        b->now += STEP_US;
        uint32_t t = clock_at(b, (double)b->now);
        b->c.driver_fault = b->values[DRIVER_FAULT] != 0;
        if (b->now - b->ticked >= 1000000 / TICK_HZ) {
            b->ticked = b->now;
            if (b->settings.encoder == MAGNETIC) magnetic(b);
            if (on_tick(&b->c, t, b->c.count)) on_sync(&b->c, t);
        }
        controller_poll(&b->c, t);
        for (int byte; written < room && (byte = controller_take(&b->c)) >= 0;) out[written++] = (uint8_t)byte;
    }
    return written;
}

/* For tests of single functions. */
void board_tamper(struct board *b, int32_t count) {
    b->c.count = b->c.last.count = count;
    tracker_begin(&b->c.tracker, count, b->settings.counts_per_turn);
}
uint32_t board_counter(const struct board *b, int which) {
    const struct frame_decoder *d = &b->c.decoder;
    return which == 0 ? d->frames : which == 1 ? d->damaged : which == 2 ? d->unknown : which == 3 ? d->lost : b->c.overruns;
}
void board_frame(uint8_t *packet, uint32_t size, uint8_t *frame, uint32_t *written) { *written = frame_encode(packet, size, frame); }
int board_q16(uint32_t bits, int32_t *q16) { return q16_from_f32(bits, q16); }
uint32_t board_f32(int32_t q16) { return f32_from_q16(q16); }
int board_angle(uint16_t frame) { return as5047_angle(frame); }
int board_step(int levels) { return quadrature_step[levels]; }
