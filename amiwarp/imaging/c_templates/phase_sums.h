/* Sums of each pixel's events in phase with a turning optic, in integers.

   $origin
   C99, or C++, without floating point, dynamic memory or a library. README.md says what the integers mean. */
#ifndef PHASE_SUMS_H
#define PHASE_SUMS_H

#include <stdint.h>

#define PHASE_WIDTH $width
#define PHASE_HEIGHT $height
#define PHASE_HARMONICS $harmonics
#define PHASE_BINS $bins
#define PHASE_MOST $most /* events of each polarity that a pixel takes, so that its sums cannot overflow */
#define PHASE_COLUMNS (3 + 2 * PHASE_HARMONICS)

struct phase_pixel {
    uint16_t events[2];                /* numbers of OFF and ON events */
    uint16_t changes;                  /* number of changes of polarity */
    uint16_t first, last;              /* rows of the table of the first and the last event */
    uint16_t unused;                   /* the sums begin at a multiple of 4 bytes */
    int32_t sums[2 * PHASE_HARMONICS]; /* of cosine and sine of each harmonic, in 1/4096 */
};

struct phase_sums {
    struct phase_pixel pixels[PHASE_HEIGHT][PHASE_WIDTH];
};

enum phase_result { PHASE_ADDED, PHASE_OUTSIDE, PHASE_FULL };

#ifdef __cplusplus
extern "C" {
#endif

void phase_clear(struct phase_sums *sums);

/* Add an event to its pixel, in the order of time: polarity 0 is OFF, another number ON; turn is the optic's angle in
   1/65536 turn. An event outside the region, or of a pixel with PHASE_MOST events of its polarity, changes nothing. */
enum phase_result phase_add(struct phase_sums *sums, uint16_t x, uint16_t y, uint16_t turn, uint8_t polarity);

/* The part of phase_add that adds a row of the table to a pixel with room. It is a function of its own because a small
   processor has too few registers for both parts at once. */
void phase_add_row(struct phase_pixel *pixel, uint16_t row);

/* Write the integers of a pixel of the region, which close the turn: numbers of OFF events, ON events and changes of
   polarity, then cosine and sine of each harmonic. The sums stay as they are. */
void phase_read(const struct phase_sums *sums, uint16_t x, uint16_t y, int32_t integers[PHASE_COLUMNS]);

#ifdef __cplusplus
}
#endif

#endif
