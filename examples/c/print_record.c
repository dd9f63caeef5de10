/* Reads records, each after its length (4 bytes, little-endian), and prints their weights.
 *
 *     gcc -O2 -o print_record print_record.c && ./print_record < records
 */
#include <stdio.h>
#include <stdlib.h>

#include "uav_beams.h"

int main(void)
{
    const size_t most = 1 << 20;
    unsigned char *room = malloc(most);
    struct uavb_record record;
    uint32_t size, n, m;
    while (room != NULL && fread(&size, sizeof size, 1, stdin) == 1) {
        if (size > most || fread(room, 1, size, stdin) != size)
            return EXIT_FAILURE;
        int error = uavb_parse(room, size, &record);
        if (error != UAVB_OK) {
            printf("error %d\n", error);
            continue;
        }
        const struct uavb_header *h = record.header;
        printf("record %llu %lld %u %u\n", (unsigned long long)h->sequence,
               (long long)h->valid_at_ns, h->elements, h->beams);
        for (n = 0; n < h->beams; n++) {
            const struct uavb_beam *beam = uavb_beam_of(&record, n);
            const float *w = uavb_weights_of(&record, n);
            printf("%s %u %.17g %.17g", beam->uav, beam->group, beam->pointing_bound_rad,
                   beam->guaranteed_gain_db);
            for (m = 0; m < 2 * h->elements; m++)
                printf(" %.9g", w[m]);
            printf("\n");
        }
    }
    free(room);
    return EXIT_SUCCESS;
}
