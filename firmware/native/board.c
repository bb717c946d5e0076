/* The controller on a computer, with a simulated motor and encoder, in simulated time: a library for Python's ctypes. */
#include <stdlib.h>
#include <string.h>

#include "motor.h"

enum { TIME = VALUES, LATE, SYNC, FASTEST, UNFED_US, PULSE_SHORTEST, PULSE_LONGEST, DRIVEN };

struct board {
    struct controller c;
    struct settings settings;
    uint64_t now, booted, ticked; /* simulated time; of the reset; of the last tick [us] */
    double clock_start, rate;     /* controller's clock at the reset [us], and its rate */
    double late_us;               /* largest delay of an index latch [us] */
    double fastest;               /* largest speed, without sign [rpm] */
    uint64_t fed, unfed_us;       /* time of the last counts, or without voltage; longest time with voltage, but no counts */
    uint64_t no_magnet;           /* time of the last angle of a magnet, or without voltage */
    int32_t fed_count;
    uint64_t pulsed, shortest_us, longest_us; /* pulse to the camera: begin or 0, and durations */
    uint16_t answer, angle;       /* magnetic encoder: its next answer, and its latest angle */
    bool error_flag;              /* of the magnetic encoder */
    uint8_t store[STORE_SLOTS][STORE_BYTES]; /* memory that outlives a reset */
    uint32_t stored;              /* bytes of the present record that are written; its slot is erased at first */
    struct motor motor;
};

static uint32_t clock_at(const struct board *b, double now) {
    return (uint32_t)(int64_t)floor(b->clock_start + (now - (double)b->booted) * b->rate);
}

void board_reset(struct board *b) {
    controller_begin(&b->c, &b->settings, 0);
    controller_load(&b->c, b->store[0], b->store[1]);
    b->stored = 0;
    b->booted = b->ticked = b->now;
    b->clock_start = 0;
}

struct board *board_new(uint32_t counts, int magnetic, int pulses, double drift_ppm, double clock_start, uint32_t seed) {
    struct board *b = calloc(1, sizeof *b);
    if (!b) return 0;
    b->settings = default_settings;
    b->settings.counts_per_turn = counts;
    b->settings.encoder = magnetic ? MAGNETIC : QUADRATURE;
    b->settings.pulses = (uint8_t)pulses;
    b->rate = 1 + drift_ppm * 1e-6;
    motor_begin(&b->motor, counts, seed);
    memset(b->store, 0xFF, sizeof b->store);
    board_reset(b);
    b->clock_start = clock_start;
    b->c.heard = b->c.checked_at = clock_at(b, 0);
    return b;
}

/* Gains for another motor than the simulated one; before the start. */
void board_tune(struct board *b, const struct gains *gains) {
    b->settings.gains = *gains;
    board_reset(b);
}
void board_set(struct board *b, int what, double value) { b->motor.values[what] = value; }
double board_get(const struct board *b, int what) {
    if (what < VALUES) return motor_get(&b->motor, what);
    const double own[] = {
        (double)b->now, b->late_us, b->c.pulse_number, b->fastest, (double)b->unfed_us, (double)b->shortest_us,
        (double)b->longest_us, b->c.enabled,
    };
    return own[what - VALUES];
}

static void begin_pulse(struct board *b) {
    pulse_begins(&b->c);
    if (!b->pulsed) b->pulsed = b->now;
}

static void move(struct board *b, double before) {
    for (double share; motor_count(&b->motor, before, &share);) {
        if (b->settings.encoder == QUADRATURE) on_edge(&b->c, motor_levels(&b->motor));
        if (has_absolute_angle(&b->settings) || !motor_index(&b->motor)) continue;
        double late = 0.5 * (uniform(&b->motor) + 1.0); /* delay of the interrupt [us] */
        uint32_t t = clock_at(b, (double)b->now + STEP_US * share + late);
        if (is_index(&b->c, t, b->c.count, b->motor.in_pulse)) {
            on_index(&b->c, t, b->c.count);
            b->late_us = fmax(b->late_us, late);
            if (b->settings.pulses == PULSES_INDEX) {
                begin_pulse(b);
                on_sync(&b->c, t);
            }
        }
        for (uint32_t k = 1; b->motor.values[BOUNCING_INDEX] != 0 && k < 5; k++) {
            if (!is_index(&b->c, t + 20 * k, b->c.count, b->motor.in_pulse == (k % 2 == 0))) continue;
            on_index(&b->c, t + 20 * k, b->c.count);
            if (b->settings.pulses == PULSES_INDEX) on_sync(&b->c, t + 20 * k);
        }
    }
}

/* Longest times in which the motor has voltage, but the encoder does not move or has no magnet. */
static void note_feedback(struct board *b) {
    bool driven = b->c.enabled && b->c.duty != 0;
    int32_t least = (int32_t)(b->settings.counts_per_turn / 1024u) + 2;
    if (!driven || abs(b->c.count - b->fed_count) >= least) {
        b->fed = b->now;
        b->fed_count = b->c.count;
    }
    if (!driven || b->settings.encoder != MAGNETIC || b->motor.values[NO_MAGNET] == 0) b->no_magnet = b->now;
    uint64_t since = b->fed < b->no_magnet ? b->fed : b->no_magnet;
    if (b->now - since > b->unfed_us) b->unfed_us = b->now - since;
    b->fastest = fmax(b->fastest, fabs(b->motor.rpm));
}

static uint16_t with_parity(uint16_t frame) {
    uint16_t parity = frame;
    for (int k = 8; k; k /= 2) parity ^= (uint16_t)(parity >> k);
    return (uint16_t)(frame | (parity & 1u) << 15);
}

static _Thread_local struct board *asked; /* the board whose encoder answers */

/* The magnetic encoder: takes a frame, and returns the answer to the one before. A damaged frame sets its error flag, which
   is in all answers until the errors have been read. */
static uint16_t transfer(uint16_t frame) {
    struct board *b = asked;
    struct motor *m = &b->motor;
    uint16_t sent = with_parity((uint16_t)(b->answer | (b->error_flag ? 0x4000u : 0u)));
    bool no_magnet = m->values[NO_MAGNET] != 0;
    if (m->values[ERROR_FLAG] != 0) {
        m->values[ERROR_FLAG] -= 1;
        b->error_flag = true;
        b->answer = 0;
    } else if (frame == AS5047_READ_ANGLE) {
        double angle = read_turns(m) * b->settings.counts_per_turn - (double)m->unseen + m->values[NOISE] * uniform(m);
        double magnet = TAU * angle / AS5047_COUNTS;
        angle += m->values[INL] * (sin(magnet + 0.4) + 0.5 * sin(2 * magnet + 1.1));
        if (no_magnet) angle = 8192 * uniform(m);
        if (m->values[DEAD_ENCODER] == 0) b->angle = (uint16_t)((int64_t)floor(angle) & 0x3FFF);
        b->answer = b->angle;
    } else if (frame == AS5047_READ_DIAGNOSIS) {
        b->answer = no_magnet ? 0x09FFu : 0x0180u;
    } else if (frame == AS5047_READ_ERRORS) {
        b->answer = b->error_flag;
        b->error_flag = false;
    } else {
        b->error_flag = true;
    }
    double bad = m->values[BAD_SPI];
    return bad > 0 && (bad >= 1 || fabs(uniform(m)) < bad) ? sent ^ 1u : sent;
}

static void magnetic(struct board *b) {
    asked = b;
    ask_encoder(&b->c, transfer);
    read_encoder(&b->c, transfer);
}

/* Write what the controller saves: one step per millisecond, so that a reset can come between all of them. */
static void save(struct board *b, uint32_t t) {
    uint8_t *slot = b->store[b->c.slot];
    if (!b->c.saving) return;
    if (b->stored == 0) memset(slot, 0xFF, STORE_BYTES);
    for (uint32_t k = 0; k < 8 && b->stored < STORE_BYTES; k++, b->stored++) {
        bool bad = b->motor.values[BAD_STORE] != 0 && b->stored == 20;
        slot[b->stored] = (uint8_t)(b->c.record[b->stored] ^ (bad ? 4u : 0u));
    }
    if (b->stored < STORE_BYTES) return;
    b->stored = 0;
    controller_saved(&b->c, memcmp(slot, b->c.record, STORE_BYTES) == 0, t);
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
        double before = read_turns(&b->motor);
        motor_turn(&b->motor, b->c.enabled, b->c.enabled ? b->c.duty / (double)FULL_DUTY : 0);
        move(b, before);
        b->now += STEP_US;
        uint32_t t = clock_at(b, (double)b->now);
        b->c.driver_fault = b->motor.values[DRIVER_FAULT] != 0;
        b->c.supply_mv = (uint16_t)(b->motor.values[DIVIDER] != 0 ? lround(1000 * motor_volts(&b->motor)) : UNKNOWN_MV);
        b->c.supply_low = b->motor.values[NO_SUPPLY] != 0 && b->motor.values[SENSED] != 0;
        if (b->now - b->ticked >= 1000000 / TICK_HZ) {
            b->ticked = b->now;
            if (pulse_ends(&b->c)) {
                uint64_t lasted = b->now - b->pulsed;
                if (!b->shortest_us || lasted < b->shortest_us) b->shortest_us = lasted;
                if (lasted > b->longest_us) b->longest_us = lasted;
                b->pulsed = 0;
            }
            if (b->settings.encoder == MAGNETIC) magnetic(b);
            if (on_tick(&b->c, t, b->c.count)) {
                begin_pulse(b);
                on_sync(&b->c, t);
            }
        }
        controller_poll(&b->c, t);
        if (b->ticked == b->now) save(b, t);
        note_feedback(b);
        for (int byte; written < room && (byte = controller_take(&b->c)) >= 0;) out[written++] = (uint8_t)byte;
    }
    return written;
}

/* For tests of single functions. */
void board_tamper(struct board *b, int32_t count) {
    b->c.count = b->c.last.count = count;
    tracker_begin(&b->c.tracker, count, 0, 1, b->settings.counts_per_turn);
}
uint32_t board_counter(const struct board *b, int which) {
    const struct frame_decoder *d = &b->c.decoder;
    return which == 0 ? d->frames : which == 1 ? d->damaged : which == 2 ? d->unknown : which == 3 ? d->lost
        : which == 4 ? b->c.overruns : which == 5 ? b->c.encoder_errors : b->c.index_bounces;
}
uint8_t *board_store(struct board *b) { return b->store[0]; }
uint32_t board_store_bytes(void) { return STORE_BYTES; }
void board_frame(uint8_t *packet, uint32_t size, uint8_t *frame, uint32_t *written) { *written = frame_encode(packet, size, frame); }
int board_q16(uint32_t bits, int32_t *q16) { return q16_from_f32(bits, q16); }
uint32_t board_f32(int32_t q16) { return f32_from_q16(q16); }
int board_angle(uint16_t frame) { return as5047_angle(frame); }
int board_step(int levels) { return quadrature_step[levels]; }
/* Gains of the control loop, from settings of any size. */
void board_gains(const struct gains *gains, int32_t *out) {
    struct speed_control c;
    speed_begin(&c, gains);
    out[0] = c.forward, out[1] = c.rise, out[2] = c.kp, out[3] = c.ki;
}
