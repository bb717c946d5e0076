/* Counts what an event costs on a simulated microcontroller, then runs the test of the integers; see small_machines.py. */
#define main test_integers
#include "test_phase_sums.c"
#undef main

enum { PASSES = 8 };

int run(void);
void finish(int result, const uint32_t times[3]);
uint32_t now(void);

extern char stack_top[];
__attribute__((section(".vectors"), used)) static const void *const vectors[2] = {stack_top, (const void *)run};

#ifdef RP2040
/* The simulator counts cycles, and notes them at each breakpoint. */
uint32_t now(void) {
    __asm volatile("bkpt 1");
    return 0;
}

void finish(int result, const uint32_t times[3]) {
    (void)times;
    register int r0 __asm("r0") = result;
    for (;;) __asm volatile("bkpt 2" ::"r"(r0));
}
#else
/* SysTick counts down; QEMU lets a nanosecond pass with each instruction. */
#define SYSTICK ((volatile uint32_t *)0xE000E010u)

uint32_t now(void) {
    if (!(SYSTICK[0] & 1u)) {
        SYSTICK[1] = 0xFFFFFFu;
        SYSTICK[2] = 0;
        SYSTICK[0] = 5; /* on, with the processor's clock */
    }
    return SYSTICK[2];
}

static void ask_host(uint32_t what, const void *with) {
    register uint32_t r0 __asm("r0") = what;
    register const void *r1 __asm("r1") = with;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void write_number(char *text, uint32_t number) {
    for (int k = 0; k < 8; ++k) text[k] = "0123456789abcdef"[number >> (28 - 4 * k) & 15u];
}

void finish(int result, const uint32_t times[3]) {
    char text[] = "00000000 00000000 0\n";
    write_number(text, (times[0] - times[1]) & 0xFFFFFFu);
    write_number(text + 9, (times[1] - times[2]) & 0xFFFFFFu);
    text[18] = (char)('0' + result);
    ask_host(4, text); /* write a text */
    const uint32_t exit_reason[2] = {0x20026, 0}; /* the program ended */
    ask_host(0x20, exit_reason);
    for (;;) {
    }
}
#endif

/* Add all events as ON, or each with another polarity than its pixel's event before: the pixels take turns. */
static void add_passes(uint16_t alternate) {
    for (uint16_t pass = 0; pass < PASSES; ++pass) {
        for (uint16_t k = 0; k < EVENTS; ++k) {
            const uint16_t *event = events[k];
            const uint16_t polarity = alternate ? k / PIXELS & 1u : 1u;
            (void)phase_add(&sums, event[0], event[1], event[2], (uint8_t)polarity);
        }
    }
}

int run(void) {
    uint32_t times[3];
    phase_clear(&sums);
    times[0] = now();
    add_passes(0);
    times[1] = now();
    add_passes(1);
    times[2] = now();
    finish(test_integers(), times);
    return 0;
}
