// Counts the events in a ring of amiwarp (docs/reference/stream-format.md, "Shared memory").
//     cc -O2 reader.c -o reader && ./reader NAME      (glibc before 2.34: also -lrt)
#include <fcntl.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static uint32_t crc32(const uint8_t *data, uint32_t size) {
    static uint32_t table[256];
    for (uint32_t k = 0; !table[255] && k < 256; k++) {
        table[k] = k;
        for (int bit = 0; bit < 8; bit++) table[k] = table[k] >> 1 ^ (table[k] & 1 ? 0xEDB88320u : 0);
    }
    uint32_t crc = ~0u;
    for (uint32_t k = 0; k < size; k++) crc = crc >> 8 ^ table[(crc ^ data[k]) & 255];
    return ~crc;
}

int main(int argc, char **argv) {
    char path[40];
    struct stat about;
    snprintf(path, sizeof path, "/%s", argc > 1 ? argv[1] : "amiwarp");
    int file = shm_open(path, O_RDONLY, 0);
    if (file < 0 || fstat(file, &about)) return perror(path), 1;
    uint8_t *ring = mmap(NULL, about.st_size, PROT_READ, MAP_SHARED, file, 0);
    if (ring == MAP_FAILED || memcmp(ring, "AMIR\1\0\0\0", 8)) return fprintf(stderr, "%s: no ring of version 1\n", path), 1;
    uint32_t head[6], row[3];  // magic, version, number and size of slots, size of the hello, place of slot 0
    memcpy(head, ring, sizeof head);
    static uint8_t packet[1 << 24];
    _Atomic uint64_t *next = (void *)(ring + 32), *beat = (void *)(ring + 40);
    uint64_t number = *next, last_beat = *beat, events = 0, lost = 0, idle = 0;
    for (puts("reading"), fflush(stdout); idle < 6000;) {  // 3 s without a beat: the writer died
        uint64_t ahead = *next - number;
        if (ahead == 0) {
            idle = *beat == last_beat ? idle + 1 : 0;
            last_beat = *beat;
            usleep(500);
            continue;
        }
        if (ahead >= head[2]) {  // overtaken: go on in the middle of the ring
            lost += ahead - head[2] / 2;
            number += ahead - head[2] / 2;
        }
        uint8_t *start = ring + head[5] + number % head[2] * head[3];
        _Atomic uint64_t *slot = (void *)start;
        if (*slot != number + 1) continue;
        memcpy(row, start + 8, 8);  // length and check
        if (row[0] < 20 || row[0] > head[3] - 16 || row[0] > sizeof packet) continue;
        memcpy(packet, start + 16, row[0]);
        memcpy(row + 2, packet + 16, 4);  // the packet's checksum
        atomic_thread_fence(memory_order_acquire);
        if (*slot != number + 1 || row[2] != (row[1] ^ (uint32_t)(number + 1))) continue;
        if (row[2] != crc32(packet + 20, row[0] - 20)) continue;
        number++;
        memcpy(row, packet + 8, 4);  // the number of events; packet[5] is the kind
        if (packet[5] == 2 || packet[5] == 3) events += row[0];
        if (packet[5] == 6) return printf("%llu events, %llu packets lost\n", (unsigned long long)events, (unsigned long long)lost), 0;
    }
    return fprintf(stderr, "the writer died\n"), 1;
}
