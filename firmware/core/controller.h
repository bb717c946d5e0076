/* The prism's controller without its hardware. A port latches counts and pulses in interrupts, calls controller_poll()
   in its main loop, sends the bytes of controller_take(), and sets the motor to `duty` and `enabled`.

   All memory is in struct controller. Nothing here is floating point. Interrupts and the main loop share only the rings,
   each with one writer and one reader, and 32-bit words. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include "encoder.h"
#include "frame.h"
#include "guard.h"
#include "settings.h"
#include "speed.h"
#include "store.h"

/* Sizes of the rings, powers of two. A port with little memory defines smaller ones. */
#ifndef TX_BYTES
#define TX_BYTES 1024u
#endif
#ifndef RX_BYTES
#define RX_BYTES 256u
#endif
#ifndef WAITING_SAMPLES
#define WAITING_SAMPLES 64u
#endif
#define WAITING_PULSES 8u
#define BATCH 5u /* samples per packet */

/* What Identity says. The version changes with the protocol's messages and the settings; 1.0 had no Identity. */
#define FIRMWARE_MAJOR 1
#define FIRMWARE_MINOR 1
#define FIRMWARE_PATCH 0
#if defined(__AVR__)
#define BOARD "ATmega2560"
#elif defined(__ARM_ARCH_6M__)
#define BOARD "RP2040"
#else
#define BOARD "simulated"
#endif

#ifdef __AVR__
typedef uint8_t ring_index; /* read and written at once; rings of 256 items at most, of which one stays free */
#else
typedef uint16_t ring_index;
#endif
struct stamp { uint32_t t; int32_t count; };
#define RING(type, n) struct { type items[n]; volatile ring_index head, tail; }

struct controller {
    struct settings settings;
    /* Written by interrupts. */
    volatile int32_t count;
    volatile uint32_t ticks, edges_lost, overruns; /* overruns: samples, pulses or bytes that found their ring full */
    volatile bool too_fast;                        /* more edges than the port counts */
    volatile uint8_t bad_answers, no_magnet;       /* of the magnetic encoder, one after the other */
    volatile uint32_t encoder_errors;              /* its answers that were damaged or had the error bit */
    volatile uint32_t index_bounces;               /* edges of the index nearer than half a turn, in one direction */
    volatile uint8_t odd_pulses;                   /* those of them that are no bounce by their time */
    uint8_t until_pulse;                           /* ticks until the next pulse to the camera */
    volatile bool interval_used;                   /* whether the main loop shall draw another interval */
    uint8_t pulse_ticks;                           /* ticks until the pulse to the camera ends */
    bool diagnosed;                                /* the magnetic encoder's next answer is its diagnosis */
    bool index_known, index_backwards;             /* the last index: whether there was one, and its direction */
    struct stamp index_at;
    uint8_t levels;                                /* 2 A + B at the last edge */
    bool backwards;                                /* direction; written by the main loop with a magnetic encoder */
    uint16_t angle;                                /* of the magnetic encoder */
    bool angle_known;
    RING(struct stamp, WAITING_SAMPLES) samples;
    RING(struct stamp, WAITING_PULSES) index;
    RING(struct stamp, WAITING_PULSES) sync;
    RING(uint8_t, RX_BYTES) rx;
    /* Written by the main loop. */
    volatile uint8_t interval; /* between the next two pulses to the camera [ms] */
    RING(uint8_t, TX_BYTES) tx;
    int32_t duty;
    bool enabled;
    /* Written by the port's main loop. */
    bool driver_fault, supply_low;
    uint16_t supply_mv; /* of the motor; UNKNOWN_MV: not sensed */
    /* Written by the main loop, and read by the port's: a record to write, and its slot. */
    bool saving;
    uint8_t slot, record[STORE_BYTES];
    /* Private. */
    struct settings built; /* those of the build */
    struct store store;
    struct frame_decoder decoder;
    struct tracker tracker;
    struct speed_control control;
    struct guard guard;
    struct stamp batch[BATCH], last, last_index;
    uint32_t random, heard, status_at, checked_at, pulse_number, edges_seen, target_bits, sent_target, sent_counts;
    uint32_t bounce_us;      /* half a turn at the fastest speed that is no fault */
    uint32_t stalled_at;     /* time of the fault stall */
    uint16_t sequence, stalled_ms, over_ms, current_ms, supply_ms, bad_turns, lost_ms;
    uint16_t save_sequence;           /* of the command that is answered once the record is written */
    uint16_t host_stops;              /* how often the motor stopped for a silent host */
    uint32_t supply_sum;              /* mean of the supply in 1/16 mV; 0: none yet */
    uint16_t supply_mean, undervoltage_ms, overvoltage_ms; /* mean [mV], or UNKNOWN_MV */
    uint16_t faults, sent_faults;
    uint8_t batched, state, sent_state, still;
    int32_t speed, over_speed;
    uint8_t odd_seen;
    uint8_t first_samples;   /* their number, until there are enough to measure the speed */
    int32_t first_count;
    uint8_t held_packet[HEADER_BYTES + SET_SPEED_BYTES], held_size; /* a command that waits for that speed */
    bool held, indexed, sampled, tracking, told, commanded;
};

void controller_begin(struct controller *c, const struct settings *built, uint32_t now);
void controller_load(struct controller *c, const uint8_t *slot0, const uint8_t *slot1); /* after controller_begin() */
void controller_saved(struct controller *c, bool good, uint32_t now); /* the record is written, and reads as it should */
void controller_poll(struct controller *c, uint32_t now);

/* What follows is called by interrupts. */

#define WAITING(ring) ((ring_index)((ring).head - (ring).tail))
#define FIRST(ring, n) (&(ring).items[(ring).tail & ((n) - 1u)])
#define DROP(ring) ((ring).tail = (ring_index)((ring).tail + 1u))

#define PUT(c, ring, n, ...) do { \
        ring_index head_ = (ring).head; \
        if ((ring_index)(head_ - (ring).tail) >= (n) - 1u) { (c)->overruns++; break; } /* 256 items are none in 8 bits */ \
        (ring).items[head_ & ((n) - 1u)] = __VA_ARGS__; \
        __asm__ volatile("" ::: "memory"); /* the item is written before the head */ \
        (ring).head = (ring_index)(head_ + 1u); \
    } while (0)

/* Next byte to send, or -1. One reader: an interrupt or the main loop. */
static inline int controller_take(struct controller *c) {
    if (!WAITING(c->tx)) return -1;
    uint8_t byte = *FIRST(c->tx, TX_BYTES);
    DROP(c->tx);
    return byte;
}

static inline void on_byte(struct controller *c, uint8_t byte) { PUT(c, c->rx, RX_BYTES, byte); }

/* Levels of A and B after an edge, 2 A + B. */
static inline void on_edge(struct controller *c, uint8_t levels) {
    int8_t step = quadrature_step[c->levels << 2 | levels];
    c->levels = levels;
    if (step == QUADRATURE_LOST) c->edges_lost++;
    else if (step) {
        c->count = (int32_t)((uint32_t)c->count + (uint32_t)step); /* wraps */
        c->backwards = step < 0;
    }
}

/* Whether the encoder gives the angle of the prism itself: the index is then its zero, and no pulse is read. */
static inline bool has_absolute_angle(const struct settings *s) {
    return s->encoder == MAGNETIC && s->counts_per_turn == AS5047_COUNTS;
}

/* Whether an edge of the index pulse at time t [us] and a count is the index: the edge at lower counts, whichever way the
   prism turns. It is the pulse's first edge forwards, its last edge backwards. One nearer than half a turn to the last index in
   the same direction is none: the sensor bounces, or the pulse is a disturbance. */
static inline bool is_index(struct controller *c, uint32_t t, int32_t count, bool rising) {
    if (rising == c->backwards) return false;
    uint32_t turned = (uint32_t)count - (uint32_t)c->index_at.count;
    if (turned >> 31) turned = 0u - turned;
    if (turned >= c->settings.counts_per_turn / 2u || c->index_backwards != c->backwards || !c->index_known) return true;
    c->index_bounces++;
    if (t - c->index_at.t >= c->bounce_us) c->odd_pulses++;
    return false;
}

/* The index, after is_index(). */
static inline void on_index(struct controller *c, uint32_t t, int32_t count) {
    c->index_known = true;
    c->index_backwards = c->backwards;
    c->index_at = (struct stamp){t, count};
    PUT(c, c->index, WAITING_PULSES, (struct stamp){t, count});
}

/* Pulse that the camera receives or sends, at time t [us]. */
static inline void on_sync(struct controller *c, uint32_t t) { PUT(c, c->sync, WAITING_PULSES, (struct stamp){t, 0}); }

/* Every millisecond: the count at time t [us]. Returns whether to send a pulse to the camera now. */
static inline bool on_tick(struct controller *c, uint32_t t, int32_t count) {
    c->ticks++;
    PUT(c, c->samples, WAITING_SAMPLES, (struct stamp){t, count});
    if (--c->until_pulse) return false;
    c->until_pulse = c->interval;
    c->interval_used = true;
    return c->settings.pulses == PULSES_TIMED;
}

/* The pulse to the camera begins; pulse_ends() is true at the tick that ends it, 1 to 2 ms later. Both with interrupts
   disabled, or from one interrupt. */
static inline void pulse_begins(struct controller *c) { c->pulse_ticks = 2; }
static inline bool pulse_ends(struct controller *c) { return c->pulse_ticks && --c->pulse_ticks == 0; }

/* Answer of the magnetic encoder with its angle, before on_tick(): updates the count. */
static inline void on_answer(struct controller *c, uint16_t frame) {
    int angle = as5047_angle(frame);
    if (angle < 0) {
        c->encoder_errors++;
        if (c->bad_answers < UINT8_MAX) c->bad_answers++;
        return;
    }
    c->bad_answers = 0;
    if (REVERSED) angle = (int)AS5047_COUNTS - 1 - angle;
    if (!c->angle_known) c->count = angle;
    else { /* the shortest way in 14 bits */
        int16_t step = (int16_t)((((uint16_t)angle - c->angle + 8192u) & 16383u) - 8192u);
        c->count = (int32_t)((uint32_t)c->count + (uint32_t)step);
    }
    c->angle = (uint16_t)angle;
    c->angle_known = true;
}

/* Answer of the magnetic encoder with its diagnosis. */
static inline void on_diagnosis(struct controller *c, uint16_t frame) {
    if (!as5047_has_no_magnet(frame)) c->no_magnet = 0;
    else if (c->no_magnet < UINT8_MAX) c->no_magnet++;
}

/* One reading of the magnetic encoder, before on_tick(): the angle is taken at the end of ask_encoder(). `transfer` sends a
   frame and returns the answer to the frame before. */
static inline void ask_encoder(struct controller *c, uint16_t (*transfer)(uint16_t)) {
    uint16_t answer = transfer(AS5047_READ_ANGLE);
    if (c->diagnosed) on_diagnosis(c, answer);
}
static inline void read_encoder(struct controller *c, uint16_t (*transfer)(uint16_t)) {
    uint16_t answer = transfer(AS5047_READ_DIAGNOSIS);
    on_answer(c, answer);
    c->diagnosed = !as5047_failed(answer);
    if (c->diagnosed) return;
    transfer(AS5047_READ_ERRORS); /* else each later answer would have the error bit */
    transfer(AS5047_READ_ANGLE);
}

#endif
