/* $origin */
#include "phase_sums.h"

/* What an event adds to the sums of its pixel, a row for each bin of OFF events, then of ON events: cosine and sine of
   each harmonic at the middle of the bin, in 1/4096; for OFF times minus the ratio $off_ratio. */
static const $entry table[2 * PHASE_BINS][2 * PHASE_HARMONICS] = {
$table};

/* What an event beside an extreme of the brightness adds once more: the polarity changes there. */
static const $entry extremes[2 * PHASE_BINS][2 * PHASE_HARMONICS] = {
$extremes};

static void add_row(int32_t *sums, const $entry *row) {
    for (uint16_t k = 0; k < 2 * PHASE_HARMONICS; k += 2) {
        sums[k] += row[k];
        sums[k + 1] += row[k + 1];
    }
}

static uint16_t is_on(uint16_t row) {
    return row >= PHASE_BINS;
}

void phase_clear(struct phase_sums *sums) {
    for (uint16_t y = 0; y < PHASE_HEIGHT; ++y) {
        for (uint16_t x = 0; x < PHASE_WIDTH; ++x) {
            struct phase_pixel *pixel = &sums->pixels[y][x];
            pixel->events[0] = 0;
            pixel->events[1] = 0;
            pixel->changes = 0;
            for (uint16_t k = 0; k < 2 * PHASE_HARMONICS; ++k) pixel->sums[k] = 0;
        }
    }
}

void phase_add_row(struct phase_pixel *pixel, uint16_t row) {
    add_row(pixel->sums, table[row]);
    if (pixel->events[0] == 0 && pixel->events[1] == 0) {
        pixel->first = row;
    } else if (is_on(pixel->last) != is_on(row)) {
        add_row(pixel->sums, extremes[pixel->last]);
        add_row(pixel->sums, extremes[row]);
        pixel->changes++;
    }
    pixel->last = row;
    pixel->events[is_on(row)]++;
}

enum phase_result phase_add(struct phase_sums *sums, uint16_t x, uint16_t y, uint16_t turn, uint8_t polarity) {
    if (x >= PHASE_WIDTH || y >= PHASE_HEIGHT) return PHASE_OUTSIDE;
    struct phase_pixel *pixel = &sums->pixels[y][x];
    if ((polarity ? pixel->events[1] : pixel->events[0]) == PHASE_MOST) return PHASE_FULL;
    const uint16_t bin = (uint16_t)(((uint32_t)turn * PHASE_BINS) >> 16);
    phase_add_row(pixel, (uint16_t)(polarity ? PHASE_BINS + bin : bin));
    return PHASE_ADDED;
}

void phase_read(const struct phase_sums *sums, uint16_t x, uint16_t y, int32_t integers[PHASE_COLUMNS]) {
    const struct phase_pixel *pixel = &sums->pixels[y][x];
    integers[0] = pixel->events[0];
    integers[1] = pixel->events[1];
    integers[2] = pixel->changes;
    for (uint16_t k = 0; k < 2 * PHASE_HARMONICS; ++k) integers[3 + k] = pixel->sums[k];
    if (pixel->events[0] == 0 && pixel->events[1] == 0) return;
    if (is_on(pixel->first) != is_on(pixel->last)) {
        integers[2]++;
        add_row(integers + 3, extremes[pixel->last]);
        add_row(integers + 3, extremes[pixel->first]);
    }
}
