/* Compares phase_sums.c with integers that amiwarp has summed; ends with 0 if they are equal.

   $origin */
#include "phase_sums.h"

enum { EVENTS = $events_count, PIXELS = $pixels_count };

/* x, y, turn and polarity of random events */
static const uint16_t events[EVENTS][4] = {
$events};

/* x and y of the pixels that have events, line by line */
static const uint16_t pixels[PIXELS][2] = {
$pixels};

/* integers of these pixels */
static const int32_t expected[PIXELS][PHASE_COLUMNS] = {
$expected};

static struct phase_sums sums;

static int add_events(void) {
    for (uint16_t k = 0; k < EVENTS; ++k) {
        const uint16_t *event = events[k];
        if (phase_add(&sums, event[0], event[1], event[2], (uint8_t)event[3]) != PHASE_ADDED) return 1;
    }
    return 0;
}

static int differ(void) {
    uint16_t next = 0;
    int32_t found[PHASE_COLUMNS];
    for (uint16_t y = 0; y < PHASE_HEIGHT; ++y) {
        for (uint16_t x = 0; x < PHASE_WIDTH; ++x) {
            const int listed = next < PIXELS && pixels[next][0] == x && pixels[next][1] == y;
            phase_read(&sums, x, y, found);
            for (uint16_t k = 0; k < PHASE_COLUMNS; ++k) {
                if (found[k] != (listed ? expected[next][k] : 0)) return 1;
            }
            next = (uint16_t)(next + listed);
        }
    }
    return next != PIXELS;
}

static int takes_what_is_outside(void) {
    return phase_add(&sums, PHASE_WIDTH, 0, 0, 1) != PHASE_OUTSIDE ||
           phase_add(&sums, 0, PHASE_HEIGHT, 0, 1) != PHASE_OUTSIDE ||
           phase_add(&sums, 65535, 65535, 0, 0) != PHASE_OUTSIDE;
}

/* The largest sums: OFF and ON events at angles at which both have the same sign. */
static int overflows(void) {
    int32_t full[PHASE_COLUMNS], after[PHASE_COLUMNS];
    phase_clear(&sums);
    for (uint32_t k = 0; k < PHASE_MOST; ++k) {
        if (phase_add(&sums, 0, 0, 0, 1) != PHASE_ADDED) return 1;
        if (phase_add(&sums, 0, 0, 32768, 0) != PHASE_ADDED) return 1;
    }
    phase_read(&sums, 0, 0, full);
    if (phase_add(&sums, 0, 0, 0, 1) != PHASE_FULL || phase_add(&sums, 0, 0, 0, 0) != PHASE_FULL) return 1;
    phase_read(&sums, 0, 0, after);
    for (uint16_t k = 0; k < PHASE_COLUMNS; ++k) {
        if (after[k] != full[k]) return 1;
    }
    return full[0] != PHASE_MOST || full[1] != PHASE_MOST || full[2] != 2 * (int32_t)PHASE_MOST || full[3] <= 0;
}

int main(void) {
    for (uint16_t round = 0; round < 2; ++round) {
        phase_clear(&sums);
        if (add_events()) return 1;
        if (differ()) return 2;
    }
    if (takes_what_is_outside() || differ()) return 3;
    if (overflows()) return 4;
    return 0;
}
