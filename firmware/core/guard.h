/* Whether the shaft answers to the motor's voltage: a motor must not be driven by an encoder that has stopped counting. */
#ifndef GUARD_H
#define GUARD_H

#include <stdbool.h>
#include <stdint.h>

/* What is found, in this order: the shaft does not move; it moves away from the reference; too much voltage for its speed. */
enum guard_finding { GUARD_GOOD, GUARD_STANDS, GUARD_RUNS_AWAY, GUARD_FALLS_BEHIND };

struct guard_input {
    int32_t count;
    int32_t speed, reference, target; /* [Q16 rpm] */
    int32_t duty;             /* 0 if the driver is off */
    int32_t lead;             /* duty in its own direction, beyond that which speed and acceleration need */
    bool limited;             /* the speed is so far behind that the reference waits */
};

struct guard {
    int32_t least_counts;  /* movement that counts as such */
    uint32_t enough;       /* sum of the reference in which the shaft must have moved [rpm ms / 16] */
    int32_t anchor;        /* count of the last movement */
    int32_t moved_at;      /* speed at it, without sign [Q16 rpm] */
    uint32_t asked;        /* sum of the reference since then [rpm ms / 16] */
    uint32_t driven;       /* sum of the duty since then [duty ms] */
    uint16_t standing_ms, kick_ms, away_ms, behind_ms, lead_ms, dropped_ms;
    int32_t away_speed, behind_speed; /* at the beginning of these times [Q16 rpm] */
    int32_t usual;                    /* mean speed of the last 32 ms [Q16 rpm] */
};

void guard_begin(struct guard *g, int32_t count, uint32_t counts_per_turn);
enum guard_finding guard_step(struct guard *g, const struct guard_input *now); /* every millisecond */

/* Additional duty for a shaft that does not start, without sign: friction at rest is larger than the gains' friction. */
int32_t guard_kick(const struct guard *g);

#endif
